"""Scattered light inside the fit: its images and derivatives, when it is estimated, checkpoints, and what it is worth."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.effect_parts import detector, rendered_from_files, stepper_of, tube
from helpers.fits import SHORT, assert_equal_states, geometry, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.effects.focal_spot import FocalSpot
from lingo_mi.effects.forward import Effects
from lingo_mi.effects.hardening import Tube, TubeParameters
from lingo_mi.effects.scatter import Scatter
from lingo_mi.files.ply import write_ply
from lingo_mi.fitting.corrections.light import WHEN
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods import densities
from lingo_mi.fitting.models.scattered_light import ScatteredLight, light_at_pixels
from lingo_mi.fitting.scene_file import write_scene
from lingo_mi.projectors.backprop import leaves, pass_on
from lingo_mi.projectors.objects import GridInCube
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.scan import Scan
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import render_with

pytest.importorskip('xraylib', reason="needs pip install 'lingo_mi[physics]'")
pytest.importorskip('spekpy', reason="needs pip install 'lingo_mi[physics]'")
FEW = Scatter(64, (4, 4), energies=1, voxels=16)


def one_energy(material='water', split=''):
    return Tube.of(TubeParameters(energy=60.0, filtration='', material=material, split=split))


def effects_of(scatter=FEW, **changes):
    return Effects(one_energy(), FocalSpot(), None, 0, scatter, **changes)


# ---- images and derivatives ------------------------------------------------------------------------------------------


@pytest.mark.traces_rays
@pytest.mark.parametrize(
    'effects',
    [
        effects_of(),
        Effects(tube('soft tissue + bone', '0.0002, 0.0006'), FocalSpot(), detector(psf=15.0), 0, FEW),
        Effects(one_energy('soft tissue + bone', '0.0002, 0.0006'), FocalSpot(), None, 0, FEW),
    ],
    ids=['one energy', 'all', 'two materials'],
)
def test_the_fit_sees_what_the_integrator_renders(effects, tmp_path):
    """The cloud written as result.xml, rendered through Mitsuba, scatters as in the fit."""
    stepper, state = stepper_of(effects)
    g, expected = stepper.geometry, stepper.model.render(state, stepper.geometry)
    for image, wanted in zip(rendered_from_files(stepper, state, effects, tmp_path), expected, strict=True):
        # A path that just meets an electron on one way to round may miss it on the other.
        np.testing.assert_allclose(image, wanted, rtol=1e-4, atol=1e-3 * expected.max())
    plain, _ = stepper_of(replace(effects, scatter=None))
    assert np.abs(plain.model.render(state, g) - expected).max() > 0.05 * expected.max()


@pytest.mark.traces_rays
def test_the_light_is_a_constant_to_the_derivatives():
    """Derivatives of the loss by the densities agree with differences at fixed light; without the light they differ."""
    stepper, state = stepper_of(effects_of(), lambda_tv=0.0)
    target, plain = stepper.targets[1], state.values['density']
    results = {}
    for lit in (False, True):
        if lit:
            [light] = stepper.corrections
            light.estimate(stepper, state)
            target.scattered = 40 * target.scattered  # as in a thick object
        state.values['density'] = mi.Float(plain)
        dr.enable_grad(state.values['density'])
        gaussians = stepper.forward.gaussians(state.values)
        leaf = leaves(gaussians)
        stepper.compare(leaf, target, 1)
        pass_on(gaussians, map(dr.grad, leaf))
        results[lit] = dr.grad(state.values['density']).numpy()

    def loss(values):
        state.values['density'] = values
        return float(stepper.compare(leaves(stepper.forward.gaussians(state.values)), target, 1)[0][0])

    way = mi.Float(np.abs(np.random.default_rng(1).normal(size=len(state))).astype(np.float32) * np.sign(results[True]))
    expected = (loss(plain + 0.02 * way) - loss(plain - 0.02 * way)) / 0.04
    assert (results[True] * way.numpy()).sum() == pytest.approx(expected, rel=2e-2)
    assert (results[False] * way.numpy()).sum() != pytest.approx(expected, rel=5e-2)


# ---- estimates -------------------------------------------------------------------------------------------------------


@pytest.mark.traces_rays
def test_when_it_is_estimated(monkeypatch):
    """The light is estimated a handful of times, at once for all views."""
    scan = replace(tiny_scan(geometry(3)), effects=effects_of())
    seen, steppers, estimate = [], [], ScatteredLight.estimate

    def counted(self, cloud, g):
        seen.append(dr.width(cloud.density))
        return estimate(self, cloud, g)

    class Kept(densities.GaussianStepper):
        def __init__(self, *args):
            super().__init__(*args)
            steppers.append(self)

    monkeypatch.setattr(ScatteredLight, 'estimate', counted)
    monkeypatch.setattr(densities, 'GaussianStepper', Kept)
    fitted = run(scan, SHORT.changed(iterations=32), seed=3)
    assert len(seen) == len(WHEN) and seen[0] == 60 and len(fitted.state) > 60
    [stepper] = steppers
    [light] = stepper.corrections
    expected = light_at_pixels(light.scattered, scan.geometry)
    for target, image in zip(stepper.targets, expected, strict=True):
        assert image.min() >= 0 and image.mean() > 1e-3
        np.testing.assert_array_equal(target.scattered.numpy(), image.ravel())


@pytest.mark.traces_rays
def test_a_fit_with_scatter_is_not_made_longer(tmp_path):
    """The light is estimated after shares of the steps: half of a longer fit is another fit."""
    scan, path = replace(tiny_scan(geometry(3)), effects=effects_of()), tmp_path / 'fit.npz'
    short = SHORT.changed(iterations=2, decay_steps=100)
    assert short.extensible
    run(scan, short, path=path)
    with pytest.raises(InputError, match='other values of iterations'):
        run(scan, short.changed(iterations=4), path=path, resume=True)


@pytest.mark.traces_rays
def test_resumed_fit_is_the_same_fit(tmp_path, variant):
    """A fit may stop between two estimates, too."""
    scan = tiny_scan(geometry(3))
    scan = replace(scan, projections=scan.projections / 50, effects=effects_of())
    whole, path = run(scan, SHORT, seed=3), tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, SHORT, seed=3, path=path, progress=stop_at(11))
    again = run(scan, SHORT, seed=3, path=path, resume=True)
    if variant.startswith('llvm'):
        assert_equal_states(again.state, whole.state)


def test_parameters_survive_result_xml(tmp_path):
    from lingo_mi.effects.forward import find_effects

    scatter = Scatter(7, (5, 6), 3, 9, 2, 11)
    g = geometry(offOrigin=(1.5, -2.0, 1 / 3))
    write_scene(tmp_path / 'result.xml', g, 7, effects_of(scatter))
    write_ply(tmp_path / 'gaussians.ply', np.zeros((1, 3)), np.ones((1, 3)), np.eye(4)[3:], np.ones(1))
    loaded = load_scene(tmp_path / 'result.xml')
    assert find_effects(loaded.scene, loaded.scanner).scatter == scatter.within(g)


# ---- what it is worth ------------------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def scans():
    """Scans of a ball of water of 200 mm: without scatter, and with scatter by other random numbers than in the fits."""
    g = geometry(12, nDetector=(24, 24), dDetector=(16.0, 16.0), nVoxel=(16, 16, 16), dVoxel=(16.0, 16.0, 16.0))
    x = (np.arange(16) - 7.5) * 16
    r = np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2)
    ball = GridInCube.of((0.0205 * np.clip((108 - r) / 16, 0, 1)).astype(np.float32), [-128] * 3, [128] * 3, 'ball')
    few = replace(FEW, paths=256)
    lit, clean = (
        render_with(e, [ball], g, np.arange(12), 0) for e in (effects_of(replace(few, seed=5)), effects_of(None))
    )
    return Scan(g, clean), Scan(g, lit, effects=replace(effects_of(few), detector=detector(photons=300.0)))


@pytest.mark.traces_rays
def test_line_integrals(scans):
    """Most of the light is taken out before FDK; without it, nothing changes; what FDK cannot reconstruct keeps it."""
    clean, lit = scans

    def error(scan):
        return np.linalg.norm(scan.projections - clean.projections) / np.linalg.norm(clean.projections)

    # With the noise of so few paths the true light would leave .27 of the error.
    assert error(line_integrals(lit)) < 0.4 * error(lit) and error(lit) > 0.2
    unscattered = line_integrals(replace(lit, effects=effects_of(None)))
    np.testing.assert_array_equal(unscattered.projections, lit.projections)
    masked = replace(lit, valid=np.indices(lit.projections.shape).sum(0) > 0)
    with pytest.warns(UserWarning, match='scatter stays'):
        np.testing.assert_array_equal(line_integrals(masked).projections, masked.projections)


@pytest.mark.thorough
@pytest.mark.traces_rays
def test_a_fit_that_models_it_finds_the_volume(scans):
    clean, lit = scans
    volumes = []
    for scan, change in ((clean, 'model'), (lit, 'model'), (lit, 'ignore')):
        method = SHORT.changed(
            iterations=60, densify_from=1000, start='masks', density='fdk', n_points=200, effects=change
        )
        fitted = run(scan, method, seed=3)
        volumes.append(fitted.volume())
    errors = [np.linalg.norm(v - volumes[0]) / np.linalg.norm(volumes[0]) for v in volumes[1:]]
    assert errors[0] < 0.4 * errors[1] and errors[1] > 0.05
