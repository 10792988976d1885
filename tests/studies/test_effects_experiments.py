"""The experiments of what modelling an effect is worth: one of them, tiny, and what is written about it."""

import json

import numpy as np
import pytest

from helpers.script import run
from lingo_mi.common.errors import InputError
from lingo_mi.scene.shipped import scenes
from studies.effects.experiments import EXPERIMENTS, FITS, METHOD, measure, quality
from studies.effects.report import write

TINY = dict(views='6', voxels='16', voxel_size='8', pixels='24', pixel_size='12')


def test_every_experiment_has_its_scene():
    assert set(EXPERIMENTS) == {name.removeprefix('effects/') for name in scenes() if name.startswith('effects/')}
    with pytest.raises(InputError, match='no experiment'):
        measure('rain')


def test_a_wrong_scale_alone_costs_nothing_after_the_gain():
    truth = np.random.default_rng(0).random((4, 5, 6))
    actual = quality(0.9 * truth, truth)
    assert actual['psnr_3d_gain'] > 200
    np.testing.assert_allclose(actual['psnr_3d'], 10 * np.log10(truth.max() ** 2 / (0.01 * (truth**2).mean())))


@pytest.mark.thorough
def test_an_experiment(tmp_path, monkeypatch):
    """The blur has three fits that differ, with their table and picture, by the function and by the command."""
    result = measure('psf', TINY, METHOD.changed(iterations=12))
    volumes = [result[kind]['volume'] for kind in FITS]
    assert all(v.shape == (16, 16, 16) and np.isfinite(v).all() for v in volumes)
    assert not np.allclose(volumes[0], volumes[1]) and not np.allclose(volumes[1], volumes[2])
    document, out = tmp_path / 'effects.md', tmp_path / 'out'
    document.write_text('<!-- table worth -->\n<!-- end worth -->\n')
    write({'psf': result}, out, tmp_path / 'figures', document)
    assert f'{result["model"]["psnr_3d"]:.2f}' in document.read_text()
    record = json.loads((out / 'effects.json').read_text())['psf']
    assert record['ignore']['psnr_3d'] == result['ignore']['psnr_3d'] and record['provenance']['date']
    assert (out / 'effects.md').read_text().count('|') == document.read_text().count('|')
    assert all((folder / 'effects.provenance.json').exists() for folder in (out, tmp_path))
    assert (tmp_path / 'figures' / 'psf.png').stat().st_size > 10_000
    monkeypatch.setattr('studies.effects.experiments.measure', lambda name: result | dict(title=name))
    script, again = 'studies.effects', tmp_path / 'again'
    code, text, err = run(script, '--only', 'psf', 'gain', '--out', again)
    assert code == 0 and '| gain |' in text and '| psf |' in text, err
    assert sorted(path.stem for path in again.glob('*.png')) == ['gain', 'psf']
    code, _, err = run(script, '--only', 'bits', '--out', again, '--docs', tmp_path)
    assert code == 0, err
    assert all(f'| {name} |' in document.read_text() for name in ('psf', 'gain', 'bits'))
    assert (tmp_path / 'figures' / 'effects' / 'bits.png').exists() and not (again / 'bits.png').exists()
    code, _, err = run(script, '--only', 'psf', 'rain', '--out', tmp_path / 'none')
    assert code == 2 and 'no experiment' in err and not (tmp_path / 'none').exists()
