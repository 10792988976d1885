"""Wherever writing stops, a folder holds the old result or the new one whole, or a checkpoint that resumes to the same metrics.

Every run tries a share of the calls that write; with --slow these are LINGO_MI_CRASH_POINTS calls (500 unless set).
"""

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from helpers.fault_server import Server
from helpers.script import SCENE
from lingo_mi.files.volumes import read_volume
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.storage.output_folder import CHECKPOINT, METRICS, digest

pytestmark = pytest.mark.posix
SHARE = 16
KINDS = 'kill', 'full', 'denied'
KEYS = 'psnr_2d', 'ssim_2d', 'psnr_3d', 'ssim_3d', 'ipsd', 'gaussians'
TINY = (('value="12"', 'value="5"'), ('value="24"', 'value="10"'), ('32, 40', '10, 12'), ('24, 24, 24', '10, 10, 10'))
FIT = (
    '--iterations',
    '5',
    '-D',
    'n_points=40',
    '-D',
    'checkpoint_seconds=0',
    '-D',
    'densify_from=1',
    '-D',
    'densify_every=2',
)
MINE = 'notes.txt', '.writable', 'metrics.json.partial', 'views/mine.exr'


def tiny():
    scene = SCENE
    for old, new in TINY:
        scene = scene.replace(old, new)
    return scene


@dataclass
class Case:
    """Command that is interrupted.

    prepare   makes the folder as it is before
    task, arguments   for `Server.run`
    accept    looks at the folder afterwards
    """

    name: str
    task: str
    arguments: list
    prepare: Callable[[], None]
    accept: Callable[[], None]
    calls: int = field(default=0)


class Bench:
    """A folder, a tiny scene, and what commands leave there when nothing goes wrong."""

    def __init__(self, server, home):
        self.server, self.home, self.box = server, home, home / 'box'
        self.out, self.volume, self.tables = self.box / 'result', self.box / 'volume.nii', self.box / 'tables'
        self.scene = home / 'tiny.xml'
        self.scene.write_text(tiny())
        self.seeds = {seed: self.fit(seed) for seed in (0, 1)}
        self.metrics = {}
        for seed, command in self.seeds.items():
            self.box.mkdir(exist_ok=True)
            self.go('fit', command)
            shutil.move(self.out, self.reference(seed))
            self.metrics[seed] = json.loads((self.reference(seed) / METRICS).read_text())
        assert abs(self.metrics[0]['psnr_2d'] - self.metrics[1]['psnr_2d']) > 0.01, 'the test could not tell them apart'
        self.fdk = [self.scene, '--algorithm', 'fdk', '--out', self.volume, '-D', 'views=7', '--force']
        self.table = [
            'ct',
            '--objects',
            'foot',
            '--views',
            '3',
            '--iterations',
            '3',
            '--methods',
            'r2',
            '--out',
            self.tables,
        ]
        self.table += ['--algorithms', 'fdk', 'voxelize']
        self.go('reconstruct', self.fdk)
        self.new_volume = read_volume(self.volume).data
        self.go('tables', self.table)
        self.rows = json.loads((self.tables / 'ct.json').read_text())

    def fit(self, seed, *more):
        return [self.scene, *FIT, '--seed', seed, '--out', self.out, *more]

    def reference(self, seed):
        return self.home / f'seed_{seed}'

    def go(self, task, arguments):
        """Run a command that must succeed."""
        code, err, _ = self.server.run(task, arguments)
        assert code == 0, err

    # ---- before ----

    def empty(self):
        shutil.rmtree(self.box, ignore_errors=True)
        self.box.mkdir()

    def old_result(self):
        """A result of seed 0 and files of somebody else."""
        self.empty()
        shutil.copytree(self.reference(0), self.out)
        for name in MINE:
            (self.out / name).write_text('mine')

    def half_a_fit(self):
        self.empty()
        code, _, _ = self.server.run('fit', self.seeds[1], self.box, self.whole_fit // 2)
        assert code == -signal.SIGKILL and (self.out / CHECKPOINT).exists() and not (self.out / METRICS).exists()

    def old_volume(self):
        self.empty()
        np.save(self.box / 'mine.npy', [1])
        self.go('reconstruct', [self.scene, '--algorithm', 'fdk', '--out', self.volume, '-D', 'views=4'])
        self.before = read_volume(self.volume).data

    # ---- afterwards ----

    def require_whole(self, seeds):
        """Require that metrics.json matches the files, views included, and the metrics of one of these fits."""
        record = json.loads((self.out / METRICS).read_text())
        assert {'result.xml', 'gaussians.ply', 'volume.nii.gz', 'report.html', CHECKPOINT} <= record['files'].keys()
        for name, value in record['files'].items():
            assert digest(self.out / name) == value, name
        assert any(self.same(record, self.metrics[seed]) for seed in seeds), {k: record[k] for k in KEYS}

    @staticmethod
    def same(actual, wanted):
        return all(actual[k] == pytest.approx(wanted[k], rel=1e-4) for k in KEYS)

    def require_result(self, seeds, empty=False):
        """Require a whole result of one of these seeds or a checkpoint of it; with `empty`, there may be nothing."""
        mine = [self.out / name for name in MINE] if 0 in seeds else []
        assert all(path.read_text() == 'mine' for path in mine)
        if (self.out / METRICS).exists():
            self.require_whole(seeds)
            return
        if empty and not (self.out / CHECKPOINT).exists():
            self.go('fit', self.seeds[1])
            self.require_whole([1])
        else:
            for seed in sorted(seeds, reverse=True):
                code, err, _ = self.server.run('fit', self.fit(seed, '--resume'))
                if code == 0:
                    self.require_whole([seed])
                    break
                assert 'other values of seed' in err, err
            else:
                raise AssertionError('no command goes on')
        assert all(path.read_text() == 'mine' for path in mine)
        left = {p.name for p in self.out.iterdir() if p.name.startswith('.lingo_mi')}
        assert left == {'.lingo_mi.json'}, left

    def require_volume(self):
        volume = read_volume(self.volume).data
        assert any(np.allclose(volume, wanted, atol=1e-6) for wanted in (self.before, self.new_volume))
        assert np.load(self.box / 'mine.npy') == [1]

    def require_table(self):
        """Require that every file is whole, and that the same command goes on to the same table."""
        for path in self.tables.rglob('[!.]*.json'):
            json.loads(path.read_text())
        self.go('tables', self.table)
        again = json.loads((self.tables / 'ct.json').read_text())
        assert len(again) == len(self.rows)
        for a, b in zip(again, self.rows):
            for column, values in b['columns'].items():
                assert (
                    values is None
                    and a['columns'][column] is None
                    or a['columns'][column] == pytest.approx(values, rel=1e-4)
                )

    def cases(self):
        """All commands that are interrupted, with the numbers of their calls that write."""
        whole = [
            Case('fit', 'fit', self.seeds[1], self.empty, lambda: self.require_result([1], empty=True)),
            Case('force', 'fit', self.fit(1, '--force'), self.old_result, lambda: self.require_result([0, 1])),
            Case('resume', 'fit', self.fit(1, '--resume'), self.half_a_fit, lambda: self.require_result([1])),
            Case('save', 'save', [self.reference(1), self.out], self.old_result, lambda: self.require_result([0, 1])),
            Case('reconstruct', 'reconstruct', self.fdk, self.old_volume, self.require_volume),
            Case('tables', 'tables', self.table, self.empty, self.require_table),
        ]
        for case in whole:
            case.prepare()
            code, err, case.calls = self.server.run(case.task, case.arguments, self.box)
            assert code == 0, err
            self.whole_fit = whole[0].calls
        return whole

    def try_point(self, case, kind, at):
        """Let the call number `at` be the last that works, and look at what is left."""
        case.prepare()
        code, err, _ = self.server.run(case.task, case.arguments, self.box, at, kind)
        if (
            code == 0
        ):  # the run had a call less than the one that was counted, or all that failed was to remove the lock
            folders = self.out.name, self.tables.name
            harmless = {name for name in self.server.failed if name.startswith('.lingo_mi.lock') or name in folders}
            assert at > case.calls - 10 and harmless == {*self.server.failed} and 'error' not in err, self.server.failed
        elif kind == 'kill':
            assert code == -signal.SIGKILL
        else:
            error_lines = [line for line in err.splitlines() if line.startswith('error: ')]
            assert code == 2 and len(error_lines) == 1 and 'Traceback' not in err and len(error_lines[0]) < 308, (
                code,
                err,
            )
        case.accept()


@pytest.fixture(scope='module')
def bench(tmp_path_factory):
    if not hasattr(os, 'fork'):
        pytest.skip('needs fork')
    with Server() as server:
        yield Bench(server, tmp_path_factory.mktemp('crashes'))


def try_points(bench, count):
    began, cases = time.monotonic(), bench.cases()
    points = [(case, kind, at) for case in cases for kind in KINDS for at in range(1, case.calls + 1)]
    chosen = [points[i] for i in np.unique(np.linspace(0, len(points) - 1, min(count, len(points))).astype(int))]
    failed = {}
    for case, kind, at in chosen:
        try:
            bench.try_point(case, kind, at)
        except Exception as error:
            failed[f'{case.name}, {kind} at call {at} of {case.calls}'] = error
    took = time.monotonic() - began
    print(f'{len(chosen)} of {len(points)} points in {took:.0f} s: {len(failed)} failed')
    assert not failed, '\n'.join(f'{name}: {error}' for name, error in failed.items())


def test_a_killed_fit_goes_on_to_the_same_numbers(tmp_path):
    """--resume does so after `kill -9` half way through the calls that write."""
    scene, whole, out = tmp_path / 'tiny.xml', tmp_path / 'whole', tmp_path / 'result'
    scene.write_text(tiny())
    with Server() as server:
        code, err, calls = server.run('fit', [scene, *FIT, '--out', whole], whole)
        assert code == 0, err
        command = [scene, *FIT, '--out', out]
        code, _, _ = server.run('fit', command, out, calls // 2)
        assert code == -signal.SIGKILL and not (out / METRICS).exists()
        assert 0 < Checkpoint.load(out / CHECKPOINT).iteration < 5
        code, err, _ = server.run('fit', [*command, '--resume'])
        assert code == 0, err
    expected, resumed = (json.loads((folder / METRICS).read_text()) for folder in (whole, out))
    assert [resumed[key] for key in KEYS] == pytest.approx([expected[key] for key in KEYS], rel=1e-4)
    assert [h['iteration'] for h in resumed['history']] == [h['iteration'] for h in expected['history']]


@pytest.mark.thorough
def test_a_share_of_all_calls_that_write(bench):
    try_points(bench, SHARE)


@pytest.mark.slow
def test_calls_that_write(bench):
    try_points(bench, int(os.environ.get('LINGO_MI_CRASH_POINTS', 500)))
