"""`python -m studies.noise`: its cells, that they are kept, the table, and bad input in one line."""

import json
import runpy
import sys

import pytest

from studies.noise.study import SETTINGS, Case, Study


def noise(monkeypatch, capsys, *args):
    """Exit code, standard output and standard error of `noise.py ARGS`."""
    monkeypatch.setattr(sys, 'argv', ['noise.py', *map(str, args)])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module('studies.noise', run_name='__main__')
    return stop.value.code, *capsys.readouterr()


def test_a_small_table(monkeypatch, capsys, tmp_path):
    small = dict(size=12, pixels=16, iterations=100)
    options = [word for name, value in small.items() for word in (f'--{name}', value)]
    arguments = ('--objects', 'foot', '--photons', 500, '--finer', 1, '--views', 6, '--out', tmp_path, *options)
    code, text, err = noise(monkeypatch, capsys, *arguments, '--variant', 'llvm_ad_mono')
    assert code == 0, err
    study, case = Study(tmp_path, **small), Case('foot', 500.0, 1, 6)
    cells = {setting: study.get(case, setting) for setting in SETTINGS}
    assert cells['equal']['steps'] == [50, 100] and cells['equal']['search'] is None
    stopped = cells['stopped']
    assert stopped['steps'][-1] == stopped['search']['best']
    assert stopped['psnr_3d'][-1] == pytest.approx(cells['equal']['psnr_3d'][stopped['steps'][-1] // 50 - 1], abs=1e-3)
    row = (tmp_path / 'noise.md').read_text().splitlines()[-1]
    assert row.startswith('| foot | x1 | 500 |') and row in text and '–' not in row
    study.cells.path(study.name(case), 'noise').write_text(json.dumps(cells['noise'] | dict(psnr_3d=[1.0, 2.0])))
    code, text, err = noise(monkeypatch, capsys, *arguments, '--variant', 'llvm_ad_mono')
    assert code == 0 and '2.00 (100)' in text, err


@pytest.mark.parametrize(
    'args, says',
    [
        (['--finer', 0], '--finer must be from 1 to 8'),
        (['--views', 3], '--views must be from 4 to 5000'),
        (['--size', 4], '--size must be from 12 to 512'),
        (['--iterations', 1], '--iterations must be from 50 to'),
        (['--photons', 0], '--photons must be from 1 to'),
        (['--settings', 'equal', 'other'], '--settings other: is unknown; use some of equal, stopped, noise'),
        (['--objects', 'cat'], "object 'cat' is unknown"),
    ],
)
def test_bad_input(monkeypatch, capsys, tmp_path, args, says):
    code, _, err = noise(monkeypatch, capsys, '--out', tmp_path / 'new', *args)
    assert code == 2 and says in err and err.count('\n') == 1 and not (tmp_path / 'new').exists()
