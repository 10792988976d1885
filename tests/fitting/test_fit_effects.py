"""Effects inside the fit: images and derivatives of its model, what it costs where there is none, checkpoints, results."""

import json
from dataclasses import replace
from importlib.util import find_spec

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.effect_parts import detector, rendered_from_files, stepper_of, tube
from helpers.effects import XML
from helpers.fits import SHORT, assert_equal_states, geometry, stop_at, tiny_scan
from helpers.script import fit
from lingo_mi.common.errors import InputError
from lingo_mi.effects.focal_spot import FocalSpot
from lingo_mi.effects.forward import Effects
from lingo_mi.effects.hardening import Tube, TubeParameters
from lingo_mi.files.images import read_exr
from lingo_mi.fitting import losses
from lingo_mi.fitting.corrections.poses import gathered, place
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.measured import weights_of
from lingo_mi.fitting.step import GaussianStepper
from lingo_mi.fitting.view_loss import evaluate
from lingo_mi.lingo.loss_scale import loss_scale
from lingo_mi.projectors.backprop import Cuts, leaves, pass_on
from lingo_mi.projectors.footprint import project
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.splat import splat
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.scan import Scan
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import take_scan

physics = pytest.mark.skipif(
    any(find_spec(m) is None for m in ('spekpy', 'xraylib')), reason="needs pip install 'lingo_mi[physics]'"
)
SPOT = FocalSpot((12.0, 8.0), 2)


def kernels(function):
    """Hashes of the kernels of a function, traced in every call."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        dr.kernel_history_clear()
        function()
        return [k['hash'] for k in dr.kernel_history([dr.KernelType.JIT])]


# ---- absent costs nothing --------------------------------------------------------------------------------------------


def plain_view(self, gaussians, target, batch):
    """`GaussianStepper.compare` with no code of an effect in it: footprints, splat, loss, derivatives."""
    s, extent, view = self.method.loss, self.method.extent, target.view
    cut = Cuts()
    footprints = project(gaussians, view, extent, cut=cut)
    leaf = leaves(footprints.values)
    image = splat(replace(footprints, values=leaf), view.height, view.width, extent) * view.lengths()
    compared = target.masked(image), target.pixels, view.height, view.width
    loss = losses.combined(*compared, s.lambda_ssim, s.lambda_gradient, s.lambda_l1)
    factor = loss_scale(dr.detach(image)) if s.loss_scale != 'none' else mi.Float(1)
    weight = (factor if s.loss_scale == 'dynamic' else mi.Float(1)) * (1 / batch)
    dr.backward(loss * weight)
    gx, gy = dr.grad(leaf[-2]), dr.grad(leaf[-1])
    with dr.suspend_grad():
        norm = dr.norm(mi.Vector2f(gx * (view.width / 2), gy * (view.height / 2))) * batch
        norm = norm * factor if s.loss_scale == 'statistic' else norm
        seen = dr.select(footprints.row_end > footprints.row_begin, mi.Float(1), 0)
    with full_float64():
        cut.pass_on(footprints.values, map(dr.grad, leaf))
    evaluate(gaussians)
    return dr.detach(loss) * (1 / batch), norm, seen, weight if s.loss_scale == 'dynamic' else None


@pytest.mark.parametrize(
    'effects, changes',
    [
        (None, {}),
        (None, dict(loss_scale='dynamic')),
        (Effects(None, None, detector(photons=1e4)), {}),
        (Effects(None, SPOT, None), dict(effects='ignore')),
    ],
)
def test_absent_costs_nothing(monkeypatch, effects, changes):
    """Without effects to model, a fit launches the kernels of a step that has never heard of them, in their order."""
    scan = replace(tiny_scan(geometry(3)), effects=effects)
    method = SHORT.changed(iterations=5, densify_from=100, **changes)
    launched = kernels(lambda: run(scan, method, seed=3))
    monkeypatch.setattr(GaussianStepper, 'compare', plain_view)
    assert launched == kernels(lambda: run(scan, method, seed=3))


@physics
def test_a_second_view_compiles_nothing():
    """This holds with all effects at once, too."""
    effects = Effects(
        tube('soft tissue + bone', '0.01, 0.03'), SPOT, detector(psf=15.0, aperture=1.0, aperture_order=2)
    )
    stepper, state = stepper_of(effects)
    rng = np.random.default_rng(0)
    first = kernels(lambda: [stepper.step(state, [v], i, rng) for i, v in enumerate((0, 1, 0))])
    second = kernels(lambda: [stepper.step(state, [v], i + 3, rng) for i, v in enumerate((2, 1))])
    assert set(second) <= set(first)


def test_kernels_do_not_grow_with_the_bundles():
    """Each kernel is of one bundle: one of all bundles would not find registers enough on a GPU."""

    def of(order):
        stepper, state = stepper_of(Effects(None, SPOT, detector(aperture=1.0, aperture_order=order)))
        return set(kernels(lambda: stepper.step(state, [1], 0, np.random.default_rng(0))))

    assert of(3) == of(2)


# ---- images and derivatives ------------------------------------------------------------------------------------------

EFFECTS = {
    'spectrum': lambda: Effects(tube(), FocalSpot(), None),
    'two materials': lambda: Effects(tube('soft tissue + bone', '0.0002, 0.0006'), FocalSpot(), None),
    'spot': lambda: Effects(Tube.of(TubeParameters(energy=60.0, filtration='')), SPOT, None),
    'blur': lambda: Effects(None, None, detector(psf=15.0)),
    'saturation': lambda: Effects(None, None, detector(saturation=0.9, gain=0.05)),
    'all': lambda: Effects(tube(), SPOT, detector(psf=15.0, aperture=1.0, aperture_order=2, saturation=0.99)),
}


@physics
@pytest.mark.parametrize('name', EFFECTS)
def test_the_fit_sees_what_the_integrator_renders(name, tmp_path):
    """The cloud written as result.xml, rendered through Mitsuba, is what the fit compares with its scan."""
    effects = EFFECTS[name]()
    stepper, state = stepper_of(effects)
    expected = stepper.model.render(state, stepper.geometry)
    for image, wanted in zip(rendered_from_files(stepper, state, effects, tmp_path), expected, strict=True):
        np.testing.assert_allclose(image, wanted, rtol=1e-4, atol=1e-4 * expected.max())
    plain, _ = stepper_of(None)
    plain.model.unit = stepper.model.unit
    assert np.abs(plain.model.render(state, stepper.geometry) - expected).max() > 5e-4 * expected.max()
    assert name != 'two materials' or 0 < stepper.model.shares(state).numpy().mean() < 1


@physics
@pytest.mark.parametrize('name', EFFECTS)
def test_derivatives_by_differences(name):
    """Derivatives of the loss by densities, scales and centres agree with differences, through the model."""
    stepper, state = stepper_of(EFFECTS[name](), lambda_tv=0.0)
    target = stepper.targets[1]
    stepper.share = stepper.model.shares(state)

    def loss(values):
        state.values = values
        return float(stepper.compare(leaves(stepper.forward.gaussians(state.values)), target, 1)[0][0])

    values = dict(state.values)
    for v in values.values():
        dr.enable_grad(v)
    state.values = values
    gaussians = stepper.forward.gaussians(state.values)
    leaf = leaves(gaussians)
    stepper.compare(leaf, target, 1)
    pass_on(gaussians, map(dr.grad, leaf))
    rng = np.random.default_rng(1)
    for key, h in (('density', 2e-2), ('scale', 2e-2), ('centre', 4e-3)):
        plain = dr.detach(values[key])
        slope = np.array(dr.grad(values[key]))
        # A random way, but uphill in every number: a sum that cancels would drown in the rounding of the loss.
        way = (np.sign(slope) * np.abs(rng.normal(size=slope.shape))).astype(np.float32)
        slope_along = float((slope * way).sum())
        move = type(plain)(way)
        ahead, behind = (
            loss({k: dr.detach(v) for k, v in values.items()} | {key: plain + s * h * move}) for s in (1, -1)
        )
        np.testing.assert_allclose(slope_along, (ahead - behind) / (2 * h), rtol=2e-2, err_msg=key)


def test_derivatives_by_the_pose_through_bundles():
    """Bundles of a focal spot move with their view: for a small spot, the derivative by its source is the derivative for one
    ray."""
    slopes = []
    for size in (0.0, 1e-3):
        stepper, state = stepper_of(Effects(None, FocalSpot((size, size), 2), None), rate_pose=(1e-3, 1e-4))
        target = stepper.targets[1]
        place(target.view, target.rays)
        stepper.compare(leaves(stepper.forward.gaussians(state.values)), target, 1)
        slopes.append(gathered(target.view).ravel())
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-3, atol=1e-3 * np.abs(slopes[0]).max())


# ---- initial clouds, masks, checkpoints, results ---------------------------------------------------------------------


@physics
def test_hardening_is_inverted_for_initial_clouds():
    g = geometry(8)
    clean = tiny_scan(g)
    clean = replace(clean, projections=clean.projections / 50)
    effects = Effects(tube(), None, None)
    bands = effects.tube.signal(['soft tissue'])
    hard = replace(clean, projections=np.stack([bands.hardened(p) for p in clean.projections]), effects=effects)
    np.testing.assert_allclose(effects.without_hardening(hard.projections), clean.projections, atol=1e-5)
    method = SHORT.changed(start='masks', n_points=50, density='fdk')
    expected, actual = (method.starting_cloud(scan, seed=2) for scan in (clean, hard))
    np.testing.assert_allclose(actual.density, expected.density, rtol=1e-3)
    np.testing.assert_allclose(actual.points, expected.points)
    ignored = method.changed(effects='ignore').starting_cloud(hard, seed=2)
    assert not np.allclose(ignored.density, expected.density, rtol=1e-2)


@physics
def test_the_volume_is_at_the_reference_energy():
    """A fit of hardened data that models the spectrum finds the volume of a fit of clean data; one that ignores it does not."""
    clean = tiny_scan(geometry(8))
    clean = replace(clean, projections=clean.projections / 20)
    effects = Effects(tube(), None, None)
    bands = effects.tube.signal(['soft tissue'])
    hard = replace(clean, projections=bands.hardened(clean.projections), effects=effects)
    volumes = []
    for scan, change in ((clean, 'model'), (hard, 'model'), (hard, 'ignore')):
        method = SHORT.changed(iterations=60, effects=change, densify_from=1000, start='masks', n_points=100)
        fitted = run(scan, method, seed=3)
        volumes.append(fitted.volume())
    errors = [np.linalg.norm(v - volumes[0]) / np.linalg.norm(volumes[0]) for v in volumes[1:]]
    assert errors[0] < 0.3 * errors[1] and errors[1] > 0.03


def test_dead_pixels_are_left_out():
    scan = replace(tiny_scan(geometry(3)), effects=Effects(None, None, detector(dead=0.1)))
    masks = [SHORT.changed(effects=e).stepper(scan).targets[0].valid for e in ('model', 'ignore')]
    dead = scan.effects.detector.maps(scan.geometry.nDetector)[1]
    np.testing.assert_array_equal(masks[0].numpy(), ~dead.ravel())
    assert masks[1] is None and 0 < dead.sum() < dead.size


def test_noise_is_weighed():
    """Weights give all pixels the same noise, dark ones too, and invalid pixels spoil no neighbour."""
    seen = detector(photons=2000.0, electronic_noise=5.0)
    p = np.broadcast_to(np.repeat([0.0, 1.0, 2.0, 3.0], 8), (2, 32, 32))
    g, effects = geometry(2), Effects(None, None, seen)
    valid = np.ones(p.shape, bool)
    valid[:, 5:7, 8:20] = False
    scan, method = Scan(g, np.where(valid, p, np.nan), valid, effects), SHORT.changed(weights='noise')
    weights = weights_of(scan, 'noise')
    noisy = np.stack([seen.measure(np.exp(-p[0]), view) for view in range(400)])[:, 12:]
    inner = [slice(8 * i + 1, 8 * i + 7) for i in range(4)]
    spread = np.array([(noisy * weights[0, 12:])[:, :, at].std() for at in inner])
    np.testing.assert_allclose(spread, spread[0], rtol=0.04)  # of the second order: 100 photons
    np.testing.assert_allclose((weights * scan.projections).max(), 3, rtol=1e-6)
    np.testing.assert_allclose(weights[0, 5:7, 9:15], weights[0, 20, 12], rtol=1e-6)
    target = method.stepper(scan).targets[0]
    np.testing.assert_allclose(target.masked(target.pixels / target.weights).numpy(), target.pixels.numpy(), rtol=1e-6)
    for without in (None, Effects(None, None, detector(psf=1.0))):
        with pytest.raises(InputError, match='weights=noise needs a ct_detector with photons or bits'):
            method.stepper(replace(scan, effects=without))


def test_rounding_is_weighed():
    """Weighted, the errors of rounding have the same standard deviation in bright and dark pixels."""
    seen, p = detector(bits=8), np.random.default_rng(0).uniform(0, 3, (1, 400, 400))
    scale = seen.deviation(np.exp(-p))
    error = (seen.measure(np.exp(-p[0]), 0) - p[0]) / scale[0]
    for low in range(3):
        np.testing.assert_allclose(error[(p[0] > low) & (p[0] < low + 1)].std(), 1, rtol=0.03)


def test_saturated_pixels_pull_only_from_above():
    """An expected value below the saturation counts as equal to it; a value above it is drawn down; FDK takes such pixels for
    air."""
    g = geometry(3)
    effects = Effects(None, None, detector(saturation=0.8, gain=0.05))
    least = effects.detector.least(g.nDetector)
    scan = replace(tiny_scan(g), effects=effects)
    light = np.exp(-scan.projections / 50)
    scan = replace(scan, projections=np.stack([effects.detector.measure(v, i) for i, v in enumerate(light)]))
    dark = scan.projections > least + 1e-6
    assert 0.1 < dark.mean() < 0.9
    linear = line_integrals(scan).projections
    np.testing.assert_array_equal(linear[~dark], 0)
    np.testing.assert_array_equal(linear[dark], scan.projections[dark])
    model, view = SHORT.stepper(scan).model.signal, SHORT.stepper(scan).targets[0].view
    factor = model.factor.numpy()[0]
    for shift, slope in ((-0.01, 0), (0.01, 1)):
        p = mi.Float(((least + shift) / factor).ravel())
        dr.enable_grad(p)
        image = model.image(lambda _: [p], view)
        np.testing.assert_allclose(image.numpy() * factor, (least + max(shift, 0)).ravel(), atol=1e-6)
        dr.backward(dr.sum(image))
        np.testing.assert_array_equal(p.grad.numpy(), slope)


@physics
def test_resumed_fit_is_the_same_fit(tmp_path, variant):
    """A fit may stop between two updates of the shares of two materials, too."""
    scan = tiny_scan(geometry(3))
    scan = replace(scan, projections=scan.projections / 50, effects=EFFECTS['two materials']())
    whole, path = run(scan, SHORT, seed=3), tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, SHORT, seed=3, path=path, progress=stop_at(15))
    again = run(scan, SHORT, seed=3, path=path, resume=True)
    if variant.startswith('llvm'):
        assert_equal_states(again.state, whole.state)


@physics
def test_what_a_fit_leaves_behind(tmp_path):
    """result.xml renders the held-out views."""
    (tmp_path / 'scene.xml').write_text(XML)
    quick = '--iterations', '40', '-D', 'n_points=300', '-D', 'densify_from=100'
    for effects in ('model', 'ignore'):
        code, _, err = fit(tmp_path / 'scene.xml', *quick, '-D', f'effects={effects}', '--out', tmp_path / effects)
        assert code == 0, err
    loaded = load_scene(tmp_path / 'model' / 'result.xml')
    test = take_scan(load_scene(tmp_path / 'scene.xml')).test
    image = np.array(mi.render(loaded.scene, sensor=loaded.scanner.view(0, test.geometry.subset([0]))))[..., 0]
    np.testing.assert_allclose(read_exr(tmp_path / 'model' / 'views' / '0000.exr'), image, atol=2e-3 * image.max())
    assert 'xray_tube' not in (tmp_path / 'ignore' / 'result.xml').read_text()
    records = {e: json.loads((tmp_path / e / 'metrics.json').read_text()) for e in ('model', 'ignore')}
    assert records['model']['settings']['effects'] == 'model'
    assert records['ignore']['settings']['effects'] == 'ignore'


@physics
@pytest.mark.parametrize(
    'effects, match',
    [
        (lambda: Effects(tube(''), None, None), 'add <string name="material"'),
        (
            lambda: Effects(Tube.of(TubeParameters(kvp=120.0, material='Al', materials=dict(bolts='Fe'))), None, None),
            'add a split',
        ),
        (
            lambda: Effects(
                Tube.of(TubeParameters(kvp=120.0, filtration='', material='Al', materials=dict(a='Fe', b='Cu'))),
                None,
                None,
            ),
            'keep two',
        ),
    ],
)
def test_what_cannot_be_modelled(effects, match):
    scan = replace(tiny_scan(geometry(3)), effects=effects())
    with pytest.raises(InputError, match=match):
        SHORT.stepper(scan)
    SHORT.changed(effects='ignore').stepper(scan)


def test_a_checkpoint_needs_the_effects_that_were_modelled(tmp_path, monkeypatch):
    """The effects are in result.xml beside the checkpoint."""
    effects, path = Effects(None, None, detector(psf=15.0)), tmp_path / 'fit.npz'
    scan = replace(tiny_scan(geometry(3)), effects=effects)
    done = run(scan, SHORT.changed(iterations=2), path=path)
    with pytest.raises(InputError, match='modelled effects'):
        Fit.load(path)
    monkeypatch.setattr('lingo_mi.fitting.save.write_report', lambda *_: None)
    again = Fit.load(done.save(tmp_path / 'fit'))
    np.testing.assert_allclose(again.render(scan.geometry), done.render(scan.geometry), rtol=1e-5, atol=1e-5)


@physics
def test_a_cloud_stands_for_all_shapes():
    """A fit of shapes of several materials has one cloud, and a start from it asks for no shape's material."""
    made = Tube.of(TubeParameters(kvp=120.0, material='water', materials=dict(bolt='Al'), split='.04, .09'))
    scan = replace(tiny_scan(geometry(8)), effects=Effects(made))
    scan = replace(scan, projections=scan.projections / 20)
    fitted = run(scan, SHORT.changed(iterations=4, densify_from=100), seed=3)
    assert fitted.model.effects.of_cloud().tube.materials_of('cloud') == ('water', 'Al')
