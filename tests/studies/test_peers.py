"""`python -m studies.peers`: its numbers against their definitions, kept cells, missing packages, bad input in one line."""

import json
import runpy
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan
from lingo_mi.files.volumes import read_volume
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.quality import psnr_3d
from lingo_mi.projectors import grid
from lingo_mi.scan import Dataset, Scan
from studies.benchmarks import mbirjax_bridge, rtk_bridge
from studies.peers.study import METHODS, Method, Study

SIZES = dict(DSO=200.0, DSD=300.0, dDetector=3.0)


@pytest.fixture
def scan(tmp_path):
    """A measured scan of a smooth object, as the file of a walnut."""
    volume = np.zeros((16, 16, 16), np.float32)
    volume[4:12, 5:10, 3:12] = 0.03
    volume = gaussian_filter(volume, 1.5)
    geometry = Geometry.cone(nDetector=24, nVoxel=16, dVoxel=2.4, angles=circular(12), **SIZES)
    views = grid.project_volume(volume, geometry)[:, :, ::-1]
    path = tmp_path / 'scan.npz'
    np.savez(path, projections=views, angles=np.degrees(geometry.angles) - 90, air=0.0, **SIZES)
    return path


@pytest.fixture
def peers(monkeypatch, capsys, tmp_path, scan):
    """Exit code, standard output and standard error of `peers.py ARGS` on that scan."""

    def run(*args, missing=()):
        for name in missing:
            monkeypatch.setitem(sys.modules, name, None)
        small = '-D', f'projections={scan}', '-D', 'voxels=16', '-D', 'voxel_size=2.4'
        monkeypatch.setattr(
            sys, 'argv', ['peers.py', 'walnut', *small, *map(str, args), '--out', str(tmp_path / 'out')]
        )
        with pytest.raises(SystemExit) as stop:
            runpy.run_module('studies.peers', run_name='__main__')
        return stop.value.code, *capsys.readouterr()

    return run


def test_a_volume_of_smaller_voxels_is_judged_on_its_own_grid(monkeypatch, scan, tmp_path):
    """Its views come from the smaller voxels, and its means are compared with the reference."""
    dataset = Dataset(read_scan(scan).train.on(Grid((16, 16, 16), (2.4, 2.4, 2.4))))
    reference = Study(dataset, tmp_path / 'reference').reference()
    for finer in (1, 2):
        whole = np.kron(reference, np.ones((finer,) * 3, np.float32))
        monkeypatch.setitem(METHODS, 'copy', Method('copy', lambda scan, whole=whole: whole))
        study = Study(dataset, tmp_path / str(finer))
        study.compute_missing(['copy'], [6])
        cell = study.get(6, 'copy')
        assert study.volume(6, 'copy').shape == (16 * finer,) * 3
        views = dataset.train.subset([1, 3, 5, 7, 9, 11]).on(dataset.train.geometry.grid.finer(finer))
        wrong = grid.project_volume(whole, views.geometry) - views.projections
        assert cell['held_out_rms'] == pytest.approx(np.sqrt(np.mean(np.square(wrong))), rel=1e-4)
        assert cell['psnr_3d'] > 60


def test_numbers_and_that_they_are_kept(peers, scan, tmp_path):
    command = '--views', 5, 6, '--methods', 'fdk', 'asd-pocs'
    code, text, err = peers(*command)
    assert code == 0, err
    folder = tmp_path / 'out' / 'walnut_16_16_16'
    train = read_scan(scan).train
    cell = json.loads((folder / '6_views' / 'asd-pocs.json').read_text())
    volume = read_volume(folder / '6_views' / 'asd-pocs.nii.gz').data
    reference = read_volume(folder / 'reference.nii.gz').data
    geometry = train.geometry.on(Grid((16,) * 3, (2.4,) * 3, train.geometry.grid.centre))
    wrong = grid.project_volume(volume, geometry.subset(slice(1, None, 2))) - train.projections[1::2]
    assert cell['held_out_rms'] == pytest.approx(np.sqrt(np.mean(wrong.astype(float) ** 2)), rel=1e-5)
    assert cell['psnr_3d'] == pytest.approx(psnr_3d(volume, reference), abs=1e-4)
    assert (folder / 'slices.png').stat().st_size > 1000
    (folder / '6_views' / 'fdk.json').write_text(json.dumps(cell | dict(method='fdk', held_out_rms=0.5)))
    code, text, err = peers(*command)
    assert code == 0 and '| 6 | FDK | 0.5000 |' in text and '6 views, asd-pocs' not in text, err
    code, _, err = peers(*command, '-D', 'voxel_size=2.5')
    assert code == 2 and err.count('\n') == 1 and 'another scan' in err


def test_a_setting_is_chosen_by_views_that_are_held_out():
    truth = np.full((8, 8, 8), 0.02, np.float32)
    geometry = Geometry.cone(nDetector=12, nVoxel=8, dVoxel=2.4, angles=circular(10), **SIZES)
    views = []

    def volume(scan, weight):
        views.append(len(scan))
        return truth * weight

    method = Method('scaled', volume, 'weight', (0.5, 1.0, np.nan, 2.0))
    chosen, settings = method.run(Scan(geometry, grid.project_volume(truth, geometry)))
    assert settings == {'weight': 1.0} and np.array_equal(chosen, truth) and views == [8, 8, 8, 8, 10]
    assert replace(method, values=(2.0,)).run(Scan(geometry, grid.project_volume(truth, geometry)))[1] == {
        'weight': 2.0
    }
    assert views[5:] == [10]


def test_missing_peers_are_left_out(peers):
    code, text, err = peers('--views', 4, '--methods', 'fdk', 'rtk-tv', 'mbirjax', missing=('itk', 'mbirjax'))
    assert code == 0 and 'rtk-tv: left out' in text and 'mbirjax: left out' in text and '| 4 | FDK |' in text, err
    code, text, err = peers('--views', 4, '--methods', 'rtk-tv', missing=('itk',))
    assert code == 2 and err == 'error: none of the --methods is installed\n'


@pytest.mark.thorough
@pytest.mark.parametrize('method, module', [('rtk-tv', 'itk'), ('mbirjax', 'mbirjax'), ('mbirjax:1', 'mbirjax')])
def test_peers(peers, tmp_path, method, module):
    module_found = pytest.importorskip(module, reason=f"{module} is not installed: pip install -e '.[reference]'")
    if module == 'itk' and not hasattr(module_found, 'RTK'):
        pytest.skip("ITK has no RTK: pip install -e '.[reference]'")
    code, text, err = peers('--views', 6, '--methods', 'sart', method)
    assert code == 0, err
    folder = tmp_path / 'out' / 'walnut_16_16_16' / '6_views'
    ours, theirs = (json.loads((folder / f'{name}.json').read_text()) for name in ('sart', method.replace(':', '_')))
    assert ('| MBIRJAX, sharpness 1 |' in text) == (method == 'mbirjax:1')
    assert ours['settings'] == {} and f'{method}, {"beta" if module == "itk" else "sharpness"} ' in text
    assert method != 'mbirjax:1' or theirs['settings'] == {'sharpness': 1.0}
    assert theirs['held_out_rms'] < 2 * ours['held_out_rms'] and theirs['psnr_3d'] > ours['psnr_3d'] - 4


@pytest.mark.parametrize(
    'args',
    [
        ('--views', 3),
        ('--views', 12),
        ('--methods', 'magic'),
        ('--methods', 'sart:2'),
        ('--methods', 'mbirjax:x'),
        ('--methods', 'rtk-tv:nan'),
        ('-D', 'voxels=none'),
    ],
)
def test_bad_input(peers, tmp_path, args):
    code, _, err = peers(*args)
    assert code == 2 and err.startswith('error: ') and err.count('\n') == 1 and not (tmp_path / 'out').exists()


def test_pixels_that_are_not_valid(tmp_path):
    """Without a true volume there is nothing to compare with, and bridges to peers refuse the scan."""
    volume = np.zeros((16, 16, 16), np.float32)
    volume[4:12, 5:10, 3:12] = 0.03
    geometry = Geometry.cone(nDetector=24, nVoxel=16, dVoxel=2.4, angles=circular(12), **SIZES)
    p = grid.project_volume(volume, geometry)
    valid = np.random.default_rng(0).random(p.shape) > 0.05
    masked = Scan(geometry, p, valid)
    with pytest.raises(InputError, match='needs every pixel'):
        Study(Dataset(masked), tmp_path / 'a').compute_missing(['sart'], [6])
    assert not list((tmp_path / 'a').glob('*/sart*'))
    for take in lambda: rtk_bridge.reconstruct('FDK', masked, None), lambda: mbirjax_bridge.reconstruct(masked, None):
        with pytest.raises(InputError, match='pixels are all valid'):
            take()
    lines = []
    study = Study(Dataset(masked, volume=volume), tmp_path / 'b')
    with pytest.warns(UserWarning, match='were filled'):
        study.compute_missing(['fdk', 'sart'], [6], lines.append)
    assert 'fdk: rms' in lines[0] and 'sart: rms' in lines[1]
