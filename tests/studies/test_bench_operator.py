"""`python -m studies.benchmarks.operator` at a few voxels, without other packages."""

import csv
import json
import sys

import pytest

from studies.benchmarks import operator

OURS = '--only', 'lingo_mi, Joseph', 'lingo_mi, exact'


@pytest.fixture
def bench(monkeypatch, capsys):
    monkeypatch.setattr(operator, 'use_variant', lambda _: None)  # the one under test stays

    def run(*args):
        monkeypatch.setattr(sys, 'argv', ['operator', *map(str, args)])
        operator.main()
        return capsys.readouterr().out

    return run


def test_the_table(bench, tmp_path):
    bench('--size', 12, '--pixels', 16, '--views', 3, '--repeats', 1, *OURS, '--out', tmp_path)
    rows = list(csv.DictReader((tmp_path / 'operator.csv').open()))
    assert [row['operator'] for row in rows] == list(OURS[1:])
    assert all(float(row['error of the adjoint']) < 1e-6 and float(row['A, CPU s']) > 0 for row in rows)
    assert json.loads((tmp_path / 'operator.provenance.json').read_text())['versions']['lingo_mi']


def test_arrays_on_the_device(bench, tmp_path, capsys):
    """Our operators alone take arrays of Dr.Jit, and are transposes there, too."""
    bench('--size', 12, '--pixels', 16, '--views', 3, '--repeats', 1, '--on-device', '--out', tmp_path)
    rows = list(csv.DictReader((tmp_path / 'operator.csv').open()))
    assert [row['operator'] for row in rows] == list(OURS[1:])
    assert all(float(row['error of the adjoint']) < 1e-6 and float(row['A.T, wall s']) > 0 for row in rows)
    with pytest.raises(SystemExit):
        bench('--on-device', '--only', 'MBIRJAX')
    assert 'take arrays of Dr.Jit' in capsys.readouterr().err


def test_packages_that_are_missing_are_left_out(bench, monkeypatch):
    for module in 'itk', 'diffct':
        monkeypatch.setitem(sys.modules, module, None)
    text = bench('--size', 12, '--only', 'RTK, Joseph', 'diffct, PyTorch')
    assert text == 'RTK, Joseph: not installed, left out\ndiffct, PyTorch: not installed, left out\n'


def test_overhead(bench):
    text = bench('--overhead', '--repeats', 1)
    assert text.splitlines()[0].startswith('bare kernel') and 'Dr.Jit' in text
