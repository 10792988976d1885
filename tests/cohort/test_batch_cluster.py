"""A cohort on a Dask cluster: a real scheduler with three workers, one of them killed, and refused combinations."""

import json
import os
import signal
import subprocess
import sys

import mitsuba as mi
import pytest

from helpers.cohorts import BATCH, events, results
from helpers.dask_cluster import cluster, wait_until
from helpers.same import fits_alike
from helpers.script import SCENE, run
from lingo_mi.storage.output_folder import CHECKPOINT, METRICS

pytest.importorskip('distributed')
KEYS = 'psnr_2d', 'ssim_2d', 'psnr_3d', 'gaussians', 'iterations'
NAMES = [f's{i}' for i in range(4)]


@pytest.fixture
def home(tmp_path):
    """A folder with a list of four scans. Each takes seconds and writes a checkpoint several times a second."""
    (tmp_path / 'tiny.xml').write_text(SCENE)
    rows = [f'{name},tiny.xml,{i + 3},400,200,0.2' for i, name in enumerate(NAMES)]
    header = 'name,geometry,views,iterations,n_points,checkpoint_seconds'
    (tmp_path / 'list.csv').write_text('\n'.join([header, *rows]))
    return tmp_path


def arguments(home, address):
    return [home / 'list.csv', '--out', home / 'out', '--cluster', address, '--variant', mi.variant(), '--threads', '1']


def start(home, address):
    command = [sys.executable, '-m', 'lingo_mi', BATCH, *arguments(home, address)]
    return subprocess.Popen([*map(str, command)], stdout=-1, stderr=-1, text=True, start_new_session=True)


def half_done(home, but=()):
    """A scan that a worker fits now, with a checkpoint, and the worker's address."""
    if not (home / 'out' / 'batch.log').exists():
        return None
    for line in events(home, 'began '):
        name, address = line.removeprefix('began ').split(': ')
        folder = home / 'out' / name
        if address not in but and (folder / CHECKPOINT).exists() and not (folder / METRICS).exists():
            return name, address
    return None


def require_all_done_once(home):
    assert [row['status'] for row in results(home).values()] == ['done'] * len(NAMES)
    assert sorted(events(home, 'done')) == [f'done {name}' for name in NAMES]
    left = [path.name for path in (home / 'out').rglob('.lingo_mi*') if path.name != '.lingo_mi.json']
    assert not left


def require_same(home, name, address):
    """Require the numbers of an uninterrupted fit on such a worker: to the bit, except on a GPU."""
    record = json.loads((home / 'out' / name / METRICS).read_text())
    rows = (home / 'list.csv').read_text().splitlines()
    (home / 'one.csv').write_text('\n'.join([rows[0], rows[1 + NAMES.index(name)]]))
    code, _, err = run(BATCH, home / 'one.csv', '--out', home / 'alone', '--cluster', address, '--threads', '1')
    assert code == 0, err
    wanted = json.loads((home / 'alone' / name / METRICS).read_text())
    assert {k: record[k] for k in KEYS} == pytest.approx({k: wanted[k] for k in KEYS}, rel=fits_alike(0))


@pytest.mark.thorough
@pytest.mark.posix
def test_a_worker_is_killed(home):
    with cluster(home, workers=3) as (address, processes):
        numbers, batch = processes(), start(home, address)
        wait_until(lambda: half_done(home) or batch.poll() is not None)
        fits_done = half_done(home)
        assert fits_done, batch.communicate()
        name, worker = fits_done
        os.kill(numbers[worker], signal.SIGKILL)
        out, err = batch.communicate(timeout=600)
        assert batch.returncode == 0, err
        begun = {name: [line for line in events(home, 'began') if line.startswith(f'began {name}:')] for name in NAMES}
        assert {n: len(lines) for n, lines in begun.items()} == dict.fromkeys(NAMES, 1) | {name: 2}
        assert worker in begun[name][0] and worker not in begun[name][1]
        (line,) = events(home, 'resumed')
        assert line.startswith(f'resumed {name}: ') and int(line.split(': ')[1]) > 1
        assert len({line.split(': ')[1] for lines in begun.values() for line in lines}) == 3  # all three have worked
        require_all_done_once(home)
        require_same(home, name, address)
        # Nothing is left to do.
        code, text, err = run(BATCH, *arguments(home, address))
        assert code == 0 and f'{len(NAMES)} of {len(NAMES)} scans are done already' in text, err
        require_all_done_once(home)


@pytest.mark.thorough
@pytest.mark.posix
@pytest.mark.parametrize('how', ['SIGINT', 'SIGKILL'])
def test_the_command_is_stopped(home, how):
    """After Ctrl-C every worker stops with a checkpoint, after `kill -9` at its next report; the same command ends the list."""
    if 'LINGO_MI_CUDA_STAND_IN' not in os.environ:  # where 400 steps take long
        rows = home / 'list.csv'  # of longer fits: workers hear of a killed command after a second or so
        rows.write_text(rows.read_text().replace(',400,', ',2000,'))
    with cluster(home, workers=2) as (address, _):
        batch = start(home, address)
        wait_until(lambda: half_done(home) or batch.poll() is not None)
        name, _ = half_done(home)
        os.kill(batch.pid, getattr(signal, how))
        out, err = batch.communicate(timeout=600)
        if how == 'SIGINT':
            assert (
                batch.returncode == 130 and err.splitlines()[-1] == 'interrupted: the same command goes on from here'
            ), err
        code, text, err = run(BATCH, *arguments(home, address))
        assert code == 0, err
        resumed = [line.split(':')[0] for line in events(home, 'resumed')]
        assert f'resumed {name}' in resumed, (events(home), err)
        require_all_done_once(home)


@pytest.mark.parametrize('number', [1, pytest.param(2, marks=pytest.mark.thorough)])
def test_local_workers(home, number):
    rows = [f'{name},tiny.xml,10,100\n' for name in NAMES[:number]]
    (home / 'list.csv').write_text('name,geometry,iterations,n_points\n' + ''.join(rows))
    code, text, err = run(BATCH, *arguments(home, f'local:{number}'))
    assert code == 0 and 'dashboard: http://127.0.0.1:' in err, err
    assert [row['status'] for row in results(home).values()] == ['done'] * number
    assert len({line.split(': ')[1] for line in events(home, 'began')}) == number


@pytest.mark.thorough
def test_workers_that_cannot_do_it(home):
    """They are refused; `tests/jobs/test_worker.py` has all cases."""
    with cluster(home, workers=1, threads_of_tasks=2) as (address, _):
        code, _, err = run(BATCH, *arguments(home, address))
    assert code == 2 and 'runs 2 tasks at once' in err and err.count('\n') == 1
