"""Growth of cost: the stages run, the laws are right, and the command writes the results that it announces."""

import contextlib
import io
import json
import runpy
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest

from lingo_mi.common.errors import InputError
from studies.growth import stages, sweep
from studies.growth.report import exponents, rows_of

pytestmark = pytest.mark.skipif(not Path('/proc/self/clear_refs').exists(), reason='asks Linux for its peak memory')


@pytest.mark.parametrize('stage', stages.DEPENDS)
def test_a_stage_runs(stage):
    stages.prepare(stage, stages.Size(*stages.TINY))()


def test_the_peak_is_that_of_the_arrays():
    """The measures of quality hold two volumes and what one slab needs; a second measurement forgets the first."""
    # In a process of its own: this one reuses memory that earlier tests have freed.
    command = [sys.executable, '-m', stages.__name__, 'measure', '96,16,2,1', '24,16,2,1']
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    large, small = map(json.loads, done.stdout.splitlines())
    assert large['peak'] > 2 * 4 * 96**3 and small['peak'] < large['peak'] / 4


def test_the_law():
    rows = [dict(stage='FDK', axis='voxels', number=10**n, seconds=3 * 100.0**n, peak=7 * 10.0**n) for n in (1, 2, 3)]
    assert sweep.exponent(rows, 'seconds') == pytest.approx(2) and sweep.exponent(rows, 'peak') == pytest.approx(1)
    assert rows_of(rows[::-1], 'FDK', 'voxels') == rows
    assert '| FDK | 2.00 | – | – | – |' in exponents(rows)


@pytest.mark.thorough
def test_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep, 'DEPENDS', {'FDK': ('voxels', 'views')})
    monkeypatch.setattr(sweep, 'SIZES', dict(voxels=(8, 16, 24), views=(2, 4)))
    monkeypatch.setattr(sweep, 'BASE', stages.Size(16, 16, 4, 100))
    code, text, err = run_growth(tmp_path)
    assert code == 0, err
    record = json.loads((tmp_path / 'growth.json').read_text())
    assert [(r['axis'], r['number']) for r in record] == [('voxels', 512), ('voxels', 4096), ('voxels', 13824)] + [
        ('views', 2),
        ('views', 4),
    ]
    assert all(row['seconds'] > 0 for row in record) and (tmp_path / 'growth.md').read_text() in text
    assert (tmp_path / 'growth.png').stat().st_size > 10_000 and (tmp_path / 'growth.provenance.json').exists()
    # What is stored is not measured again, and a stage that fails does not lose it.
    monkeypatch.setattr(sweep, 'DEPENDS', {'FDK': ('voxels', 'views'), 'voxelise': ('views',)})
    monkeypatch.setattr(sweep, '_measured', mock.Mock(side_effect=InputError('voxelise: no')))
    code, _, err = run_growth(tmp_path)
    assert code == 2 and err.splitlines()[-1] == 'error: voxelise: no' and sweep._measured.call_count == 1
    assert json.loads((tmp_path / 'growth.json').read_text()) == record
    (tmp_path / 'growth.json').write_text('{"mine": 1}')
    code, _, err = run_growth(tmp_path)
    assert code == 2 and 'growth.json: holds no measurements' in err and err.count('\n') == 1


def run_growth(folder):
    """Exit code, standard output and standard error of `python -m studies.growth --out FOLDER`."""
    out, err = io.StringIO(), io.StringIO()
    argv = ['growth', '--out', str(folder)]
    with mock.patch.object(sys, 'argv', argv), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            runpy.run_module('studies.growth', run_name='__main__')
            code = 0
        except SystemExit as stop:
            code = stop.code
    return code, out.getvalue(), err.getvalue()
