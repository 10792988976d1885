"""`python -m studies.bench_recon` at a few voxels; against RTK where it is installed."""

import json
import runpy
import sys

import numpy as np
import pytest


@pytest.fixture
def bench(tmp_path, monkeypatch, capsys):
    def run(*args, missing=()):
        for name in missing:
            monkeypatch.setitem(sys.modules, name, None)
        monkeypatch.setattr(sys, 'argv', ['bench_recon', *args, '--json', str(tmp_path / 'a.json')])
        with pytest.raises(SystemExit) as stop:
            runpy.run_module('studies.bench_recon', run_name='__main__')
        return stop.value.code, capsys.readouterr(), tmp_path / 'a.json'

    return run


def test_without_peers(bench):
    code, captured, path = bench('--size', '16', '--views', '6', '--repeats', '2', missing=('itk', 'diffct'))
    assert code == 0 and 'RTK: not installed' in captured.out and 'diffct: not installed' in captured.out
    record = json.loads(path.read_text())['operations']
    assert list(record) == ['projector', 'transpose', 'FDK', 'SART']
    assert [list(x) for x in record.values()] == [['ours', 'exact']] * 2 + [['ours']] * 2
    assert all(x['ours']['seconds'] > 0 for x in record.values())
    assert 0 < record['projector']['exact']['deviation'] < 0.1


@pytest.mark.parametrize('tilt', [0, 20])
def test_against_rtk(bench, tilt):
    itk = pytest.importorskip('itk', reason="RTK is not installed: pip install -e '.[reference]'")
    if not hasattr(itk, 'RTK'):
        pytest.skip("ITK has no RTK: pip install -e '.[reference]'")
    sizes = ('--size', '48', '--views', '24', '--repeats', '1', '--tilt', str(tilt))
    code, captured, path = bench(*sizes, missing=('diffct',))
    assert code == 0, captured.err
    record = json.loads(path.read_text())['operations']
    tolerances = dict(projector=1e-5, transpose=0.005, SART=0.3) | ({} if tilt else dict(FDK=0.005))
    assert set(record) == set(tolerances)
    for operation, tolerance in tolerances.items():
        theirs = record[operation]['RTK']
        assert 0 < theirs['deviation'] < tolerance and np.isfinite(theirs['ratio'])


@pytest.mark.parametrize('args', [('--size', '4'), ('--views', '0'), ('--repeats', '0'), ('--tilt', 'nan')])
def test_bad_input(bench, args):
    code, captured, path = bench(*args)
    assert code == 2 and captured.err.startswith('error: ') and captured.err.count('\n') == 1 and not path.exists()
