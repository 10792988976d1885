"""`python -m studies.regret`: its cells, that they are kept, the table, and bad input in one line."""

import json
import runpy
import sys

import numpy as np
import pytest

from lingo_mi.validation.tables.photons import counting, noisy
from studies.regret.study import BEST, CLOUDS, VOXELS, Case, Study


def regret(monkeypatch, capsys, *args):
    """Exit code, standard output and standard error of `regret.py ARGS`."""
    monkeypatch.setattr(sys, 'argv', ['regret.py', *map(str, args)])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module('studies.regret', run_name='__main__')
    return stop.value.code, *capsys.readouterr()


@pytest.mark.thorough
def test_a_small_table(monkeypatch, capsys, tmp_path):
    command = (
        '--objects',
        'foot',
        '--finer',
        1,
        '--views',
        6,
        '--size',
        12,
        '--out',
        tmp_path,
        '--variant',
        'llvm_ad_mono',
    )
    code, text, err = regret(monkeypatch, capsys, *command)
    assert code == 0, err
    study, case = Study(tmp_path, 12), Case('foot', 1, 6)
    cells = {setting: study.get(case, setting) for setting in (*VOXELS, BEST)}
    assert all(cell['psnr_3d'] > 15 and cell['seconds'] > 0 for cell in cells.values())
    behind = max(cells[name]['psnr_3d'] for name in VOXELS) - cells[BEST]['psnr_3d']
    row = (tmp_path / 'regret.md').read_text().splitlines()[-1]
    assert row.startswith('| foot | x1 | 6 | no noise |') and f'| {behind:+.2f} |' in row and row in text
    assert '–' not in row and not any(label in text for label in CLOUDS.values() if label not in VOXELS.values())
    assert json.loads((tmp_path / 'regret.provenance.json').read_text())['command'].startswith(
        'python -m studies.regret '
    )
    cell_file = study.cells.path(study.name(case), 'refined')
    cell_file.write_text(json.dumps(cells['refined'] | dict(psnr_3d=99.0)))
    study.cells.path(study.name(case), BEST).write_text('{')  # cut short: computed again
    code, text, err = regret(monkeypatch, capsys, *command)
    assert code == 0 and '99.00' in text and f'{cells[BEST]["psnr_3d"]:.2f} (' in text, err


def test_the_measured_walnut(data, tmp_path):
    """It has the voxels asked for, as large as all together need; its truth is the FDK of all views."""
    dataset = Study(tmp_path, 8).dataset(Case('walnut', views=30))
    geometry = dataset.train.geometry
    assert tuple(geometry.grid.shape) == (8, 8, 8) and len(dataset.train) == 30
    np.testing.assert_allclose(8 * np.array(geometry.grid.spacing), 128 * 0.305)
    assert dataset.volume.shape == (8, 8, 8) and dataset.volume.max() > 0.01


def test_noise_is_that_of_photons():
    views = np.full((40, 40, 40), 2.0, np.float32)
    actual = noisy(views, counting(1000.0))
    assert abs(actual.std() / np.sqrt(np.exp(2.0) / 1000) - 1) < 0.05 and abs(actual.mean() - 2) < 0.01
    assert np.isfinite(noisy(views + 20, counting(1000.0))).all()


@pytest.mark.parametrize(
    'args, says',
    [
        (['--finer', 0], '--finer must be from 1 to 8'),
        (['--views', 3], '--views must be from 4 to 5000'),
        (['--size', 4], '--size must be from 12 to 512'),
        (['--photons', -1], '--photons must be 0, or from 1'),
        (['--objects', 'cat'], "object 'cat' is unknown"),
    ],
)
def test_bad_input(monkeypatch, capsys, tmp_path, args, says):
    code, _, err = regret(monkeypatch, capsys, '--out', tmp_path / 'new', *args)
    assert code == 2 and says in err and err.count('\n') == 1 and not (tmp_path / 'new').exists()
