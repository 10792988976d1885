"""The cells of the paper's tables on three workers, one of them killed: the same numbers as from undisturbed workers."""

import json
import os
import signal
import threading

import mitsuba as mi
import pytest

from helpers.dask_cluster import cluster, wait_until
from helpers.script import run
from lingo_mi.storage.folder_lock import locked
from lingo_mi.validation.tables.cells import SCALES, Cells, Fit, Scale, Volume

pytest.importorskip('distributed')
TABLES = 'studies.tables'
TINY = Scale(16, 24, 200, (20,), ('foot',))
METHOD = 'r2:checkpoint_seconds=0.1'
ARGUMENTS = (
    '--objects',
    'foot',
    '--views',
    4,
    5,
    6,
    '--iterations',
    150,
    '--methods',
    METHOD,
    '--algorithms',
    'fdk',
    'voxelize',
)
FITS = [Fit('foot', n, METHOD, 150) for n in (4, 5, 6)]


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(SCALES, 'small', TINY)


def tables(out, *more):
    return run(TABLES, 'ct', *ARGUMENTS, '--out', out, '--variant', mi.variant(), *more)


@pytest.mark.thorough
@pytest.mark.posix
def test_a_worker_is_killed(tmp_path):
    out, cells = tmp_path / 'out', Cells(tmp_path / 'out', TINY)
    killed = []

    def begun(fit):
        return cells.path(fit).with_name('checkpoint.npz').exists() and not cells.path(fit).exists()

    def kill(processes):
        wait_until(lambda: any(map(begun, FITS)))
        owner = next(cells.folder_of(fit) for fit in FITS if begun(fit)) / '.lingo_mi.lock'
        killed.append(json.loads(owner.read_text())['pid'])
        assert killed[0] in processes.values()
        os.kill(killed[0], signal.SIGKILL)

    with cluster(tmp_path, workers=3) as (address, processes):
        watch = threading.Thread(target=kill, args=[processes()])
        watch.start()
        code, text, err = tables(out, '--cluster', address, '--threads', 1)
        watch.join()
        assert code == 0 and '9 of 9 cells' in text and killed, err
        stored = {path: path.stat().st_mtime_ns for path in out.rglob('[!.]*.json') if path.parent != out}
        assert len(stored) == 9 and not [*out.rglob('.lingo_mi[!.]*'), *out.rglob('.lingo_mi.lock')]
        command = json.loads(cells.path(FITS[0]).read_text())['provenance']['command']
        assert 'python -m studies.tables ct --objects foot' in command
        # Everything is there: nothing is computed again.
        code, text, err = tables(out, '--cluster', address, '--threads', 1)
        assert code == 0 and {path: path.stat().st_mtime_ns for path in stored} == stored, err
        code, text, err = tables(tmp_path / 'whole', '--cluster', address, '--threads', 1)
        assert code == 0, err
    whole = Cells(tmp_path / 'whole', TINY)
    tolerance = 0 if mi.variant().startswith('llvm') else 1e-3  # a GPU adds in any order
    for fit in FITS:
        for cell in fit, Volume(fit, 'fdk'), Volume(Fit('foot', fit.views, 'none'), 'fdk'):
            assert cells.get(cell)['psnr_3d_r2'] == pytest.approx(whole.get(cell)['psnr_3d_r2'], rel=tolerance)


@pytest.mark.thorough
def test_a_series_that_fails(tmp_path):
    """If another process has the folder of one series, the other cells are computed, and the line says which one failed."""
    cells, fit = Cells(tmp_path / 'out', TINY), Fit('foot', 4, 'none')
    with locked(cells.folder_of(fit)), cluster(tmp_path, workers=1) as (address, _):
        code, text, err = tables(tmp_path / 'out', '--cluster', address, '--iterations', 5)
    assert code == 2 and '8 of 9 cells' in text, err
    last = err.splitlines()[-1]
    assert last.startswith(f'error: 1 of 9 cells failed, the first one ({fit}, fdk): ') and 'is writing there' in last
