"""Fits to scans of curved panels."""

import json

import mitsuba as mi
import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.fit import Fit
from lingo_mi.functional import project
from lingo_mi.geometry import CurvedGeometry
from lingo_mi.scan import Dataset, Scan
from lingo_mi.validation.oracle import random_cloud

PANEL = dict(nDetector=(20, 48), dDetector=(3.0, 4.0), offDetector=(0.0, 1.0))


def dataset(**changes):
    """A cloud of Gaussians before a panel of 100 degrees a quarter of a pixel off."""
    flat = lm.Geometry.cone(
        DSO=45.0, DSD=110.0, **PANEL, nVoxel=(20, 20, 14), dVoxel=2.0, angles=lm.circular(24), **changes
    )
    cloud = random_cloud(np.random.default_rng(0), 30, spread=14, size=3.0)
    cloud = cloud.changed(centre=cloud.centre * [1, 1, 0.3], density=0.2 * cloud.density)
    g = flat.curved()
    scan = Scan(g, project(cloud.centre, cloud.scale, cloud.rotation, cloud.density, g))
    return Dataset(scan.subset(np.arange(0, 24, 2)), scan.subset(np.arange(1, 24, 2)))


@pytest.fixture(scope='module')
def data():
    return dataset()


@pytest.mark.parametrize(
    'method',
    [lm.Fast(), pytest.param(lm.R2(), marks=pytest.mark.thorough), lm.LINGO().changed(n_points=4000)],
    ids=lambda m: m.name,
)
def test_fit(method, data, tmp_path, no_report):
    """Held-out views are predicted, and a saved result is read with its curved panel."""
    fit = lm.fit(data, method, iterations=120, progress=False)
    psnr = fit.metrics()['psnr_2d']
    assert psnr > 30
    if not isinstance(method, lm.Fast):
        return
    flat = Dataset(
        Scan(data.train.geometry.flat, data.train.projections), Scan(data.test.geometry.flat, data.test.projections)
    )
    assert psnr > lm.fit(flat, method, iterations=120, progress=False).metrics()['psnr_2d'] + 1
    fit.save(tmp_path / 'fit')
    assert json.loads((tmp_path / 'fit' / 'metrics.json').read_text())['psnr_2d'] == pytest.approx(psnr)
    again = Fit.load(tmp_path / 'fit')
    assert isinstance(again.geometry, CurvedGeometry)
    np.testing.assert_array_equal(again.render(data.test.geometry), fit.render(data.test.geometry))


def test_the_scene_of_a_result_renders_it(data, tmp_path, no_report):
    """This holds also if poses were corrected, so that no two panels are alike."""
    for name, rates in (('plain', '0,0'), ('poses', '2e-4,2e-5')):
        fit = lm.fit(data, lm.Fast(iterations=40).changed(rate_pose=rates), progress=False)
        assert isinstance(fit.geometry, CurvedGeometry)
        fit.save(tmp_path / name)
        scene = mi.load_file(str(tmp_path / name / 'result.xml'))
        scanner = scene.sensors()[0]
        assert isinstance(scanner.geometry, CurvedGeometry)
        for view in (0, 7):
            expected = fit.render(fit.geometry.subset([view]))[0]
            image = np.array(mi.render(scene, sensor=scanner.view(view)))[..., 0]
            np.testing.assert_allclose(image, expected, atol=2e-6 * expected.max())


def test_what_needs_a_flat_panel(data):
    for method in (lm.GaussianSplatting(iterations=2), lm.NAF(iterations=2)):
        with pytest.raises(InputError, match=r'scan\.to_flat\(\)'):
            lm.fit(data, method, progress=False)
    with pytest.raises(InputError, match=r'scan\.to_flat\(\)'):
        lm.calibrate(data, progress=False)
