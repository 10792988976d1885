"""Effects in scenes: what they cost, which is nothing where they are absent; images, derivatives, scans and errors."""

from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import lingo_mi as lm
from helpers.effects import XML, direct, kernels, physics
from helpers.scenes import SCANNER, block, cloud_of, ellipsoids, grid, load, render, values_of
from lingo_mi.common.errors import InputError
from lingo_mi.effects.bands import band
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects, find_effects
from lingo_mi.effects.hardening import Tube, TubeParameters, hardened
from lingo_mi.effects.spectrum import attenuation, tube_spectrum
from lingo_mi.projectors.objects import find_objects
from lingo_mi.reconstruction.line_integrals import corrected, line_integrals
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import take_scan

TUBE = dict(type='xray_tube', kvp=120.0, material='soft tissue', bands=5)


def detector(**changes):
    return dict(type='ct_detector', **changes)


def scene_of(objects=None, tube=None, film=None, **settings):
    objects = objects or dict(cloud=ellipsoids(cloud_of()))
    return load(objects | (dict(tube=tube) if tube else {}), SCANNER | (dict(film=film) if film else {}), **settings)


def integrals(shape):
    return render(load(dict(box=shape))).ravel()


# ---- absent costs nothing --------------------------------------------------------------------------------------------


def through_mitsuba(scene):
    scene.integrator().render(scene, scene.sensors()[0])


@pytest.mark.parametrize('name', ['cloud', 'grid', 'block'])
def test_absent_costs_nothing(name):
    """A scene without effects launches the projectors' kernels and no others, in their order."""
    scene = load({name: dict(cloud=ellipsoids(cloud_of()), grid=grid(values_of()), block=block())[name]})
    expected = kernels(partial(direct, scene))
    assert expected and kernels(partial(through_mitsuba, scene)) == expected


def kernels_with(*pairs):
    """The kernels of one cloud by one scanner, for each (tube, film)."""
    # The same arrays in all scenes: the order of a kernel's arguments, and so its hash, may follow theirs.
    cloud, scanner = dict(cloud=mi.load_dict(ellipsoids(cloud_of()))), mi.load_dict(SCANNER)
    return [
        kernels(
            partial(
                through_mitsuba,
                load(cloud | (dict(tube=tube) if tube else {}), SCANNER | dict(film=film) if film else scanner),
            )
        )
        for tube, film in pairs
    ]


@physics
def test_a_spectrum_adds_one_kernel():
    ideal, launched = kernels_with((None, None), (dict(TUBE, bands=2), None))
    assert launched[:-1] == ideal and launched[-1] not in ideal


def test_a_blur_adds_kernels_after_the_projectors():
    ideal, launched = kernels_with((None, None), (None, detector(psf=0.3)))
    assert launched[: len(ideal)] == ideal and len(launched) > len(ideal)
    assert not set(launched[len(ideal) :]) & set(ideal)


@pytest.mark.parametrize(
    'tube, film',
    [
        (dict(type='xray_tube', energy=60.0, focal_spot='.2', focal_order=2), None),
        (None, detector(aperture=1.0, aperture_order=2)),
    ],
)
def test_bundles_of_rays_repeat_the_projectors(tube, film):
    """Kernels of the splat run once for each of 2 x 2 bundles; those that move a view, sum and take the logarithm are new."""
    ideal, launched = kernels_with((None, None), (tube, film))
    assert max(launched.count(h) for h in ideal) == 4
    assert set(launched) - set(ideal) and launched[-1] not in ideal


@pytest.mark.parametrize(
    'tube, film',
    [
        (dict(type='xray_tube', energy=60.0), None),
        (None, detector(photons=1e4, electronic_noise=5.0, saturation=0.9, bits=12, gain=0.01, dead=0.01)),
    ],
)
def test_what_is_no_matter_of_kernels(tube, film):
    """Photons of the reference energy from a point add no kernel, and neither do effects after the light, in NumPy."""
    ideal, launched = kernels_with((None, None), (tube, film))
    assert launched == ideal


# ---- hardening -------------------------------------------------------------------------------------------------------


def full(*pairs):
    """-ln of the detected signal by the full spectrum, of (line integrals, material)."""
    spectrum = tube_spectrum(120.0)
    ratios = (attenuation(m, spectrum.energies) / attenuation(m, [60.0]) for _, m in pairs)
    exponent = sum(np.asarray(p, float)[:, None] * r for (p, _), r in zip(pairs, ratios))
    return -np.log(np.exp(-exponent) @ spectrum.detected('energy'))


@physics
def test_gaussians_grids_and_meshes_harden():
    objects = dict(cloud=ellipsoids(cloud_of()), grid=grid(values_of()), bolt=block(3.0))
    p = {k: integrals(v) for k, v in objects.items()}
    image = render(scene_of(objects, dict(TUBE, material_bolt='Fe'))).ravel()
    np.testing.assert_allclose(image, full((p['cloud'] + p['grid'], 'soft tissue'), (p['bolt'], 'Fe')), atol=2e-3)
    assert np.abs(image - sum(p.values())).max() > 0.1


@physics
def test_two_materials():
    """A grid is split by its values, Gaussians by an attribute."""
    values = values_of()
    share = np.clip((values - 0.3) / 0.4, 0, 1)
    two = dict(TUBE, material='soft tissue + bone', split='0.3, 0.7')
    expected = full((integrals(grid(values * (1 - share))), 'soft tissue'), (integrals(grid(values * share)), 'bone'))
    np.testing.assert_allclose(render(scene_of(dict(grid=grid(values)), two)).ravel(), expected, atol=5e-4)

    cloud, share = cloud_of(), np.linspace(0, 1, 6)
    mixed = ellipsoids(cloud) | dict(second=mi.TensorXf(np.float32(share)[:, None]))
    parts = (integrals(ellipsoids(cloud.changed(density=cloud.density * s))) for s in (1 - share, share))
    expected = full(*zip(parts, ('soft tissue', 'bone')))
    np.testing.assert_allclose(render(scene_of(dict(cloud=mixed), two)).ravel(), expected, atol=5e-4)


@physics
@pytest.mark.parametrize('materials', [('water',), ('soft tissue', 'bone')])
def test_derivative_of_hardening(materials):
    """Derivatives by every material's line integral agree with differences of the float64 form."""
    spectrum = tube_spectrum(120.0)
    ratios = [attenuation(m, spectrum.energies) / attenuation(m, [60.0]) for m in materials]
    bands = band(spectrum.detected('energy'), ratios, 4, 10.0)
    p = np.random.default_rng(0).uniform(0, 12, (len(materials), 200)).astype(np.float32)
    arrays = [mi.Float(x) for x in p]
    dr.enable_grad(arrays)
    image = hardened(arrays, bands)
    dr.backward(image)
    np.testing.assert_allclose(image.numpy(), bands.hardened(*p.astype(float)), rtol=2e-6, atol=1e-6)
    for m, step in enumerate(np.eye(len(materials)) * 1e-4):
        ahead, behind = (bands.hardened(*(p.astype(float) + s * step[:, None])) for s in (1, -1))
        np.testing.assert_allclose(dr.grad(arrays[m]).numpy(), (ahead - behind) / 2e-4, rtol=1e-5)


@physics
def test_derivative_through_a_scene():
    """With spectrum, focal spot, aperture and blur at once, the derivative by a density agrees with differences of images."""
    tube = dict(TUBE, focal_spot='.3, .2', focal_order=2)
    film = detector(psf=0.3, aperture=1.0, aperture_order=2, photons=1e5)
    weights = np.random.default_rng(2).normal(size=(23, 30, 1))
    cloud, step = cloud_of(), 0.05

    def loss(density):
        still = dict(film)
        del still['photons']
        return (render(scene_of(dict(cloud=ellipsoids(cloud.changed(density=density))), tube, still)) * weights).sum()

    scene = scene_of(dict(cloud=ellipsoids(cloud)), tube, film)
    params = mi.traverse(scene)
    dr.enable_grad(params['cloud.density'])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params) * mi.TensorXf(np.float32(weights)), axis=None))
    gradient = dr.grad(params['cloud.density']).numpy()
    expected = (loss(cloud.density + step * np.eye(6)[2]) - loss(cloud.density - step * np.eye(6)[2])) / (2 * step)
    assert abs(gradient[2] - expected) < 1e-3 * np.abs(gradient).max()


@pytest.mark.parametrize('output', ['line_integral', 'transmission'])
def test_what_saturates_has_no_derivative(output):
    """Derivatives are those without saturation where pixels are darker, and zero elsewhere, in both modes."""
    weights = np.random.default_rng(2).normal(size=(23, 30, 1)).astype(np.float32)
    dark = render(scene_of()) > -np.log(0.95)
    assert 0.05 < dark.mean() < 0.95

    def derivatives(weights, film):
        scene = scene_of(None, None, film, output=output)
        params = mi.traverse(scene)
        dr.enable_grad(params['cloud.density'])
        params.update()
        dr.backward(mi.render(scene, params) * mi.TensorXf(weights))
        reverse = dr.grad(params['cloud.density']).numpy()
        dr.set_grad(params['cloud.density'], 1)
        return reverse, dr.forward_to(mi.render(scene, params)).numpy() * weights

    gradient = derivatives(weights, detector(saturation=0.95))
    expected = derivatives(weights * dark.reshape(weights.shape), None)
    for f, e in zip(gradient, expected):
        np.testing.assert_allclose(f, e, atol=1e-6 * np.abs(e).max())


@pytest.mark.parametrize('film', [dict(gain=0.3), dict(gain=0.2, saturation=0.9)])
def test_derivative_with_gains_that_are_left_in(film):
    """The derivative of the measured image agrees with differences."""
    scene = scene_of(None, None, detector(corrected=False, **film), output='transmission')
    params = mi.traverse(scene)
    density = mi.Float(params['cloud.density'])

    def image(factor):
        params['cloud.density'] = density * factor
        params.update()
        return np.array(mi.render(scene, params), float).ravel()

    differences = (image(1.01) - image(0.99)) / 0.02
    params['cloud.density'] = density
    dr.enable_grad(params['cloud.density'])
    params.update()
    dr.set_grad(params['cloud.density'], density)
    actual = dr.forward_to(mi.render(scene, params)).numpy().ravel()
    smooth = np.abs(image(1.01) + image(0.99) - 2 * image(1)) < 1e-4  # not where saturation ends in between
    assert smooth.mean() > 0.9 and np.abs(differences).max() > 0.01
    np.testing.assert_allclose(actual[smooth], differences[smooth], atol=2e-4)


# ---- focal spot and aperture -----------------------------------------------------------------------------------------


def edge_moments(tube, film, size=0.0025, columns=1600):
    """Mean and variance of the edge spread, in mm on the panel, of a dense plate half way from source to panel."""
    sensor = dict(
        SCANNER,
        DSO=5.0,
        DSD=10.0,
        offDetector='0, 0',
        angles='0',
        nDetector=f'1, {columns}',
        dDetector=f'{size}, {size}',
    )
    where = mi.ScalarTransform4f().translate([0, 2, 0]).scale([0.01, 2, 1])
    plate = dict(
        type='cube',
        to_world=where,
        bsdf=dict(type='null'),
        interior=dict(type='homogeneous', sigma_t=2000.0, albedo=0.0),
    )
    objects = dict(plate=plate) | (dict(tube=tube) if tube else {})
    light = render(load(objects, sensor | (dict(film=film) if film else {}), output='transmission')).ravel()
    spread, at = -np.diff(light), (np.arange(1, columns) - columns / 2) * size
    assert abs(spread.sum() - 1) < 1e-5
    mean = (spread * at).sum()
    return mean, (spread * (at - mean) ** 2).sum()


@pytest.mark.parametrize(
    'tube, film, variance',
    [
        (dict(type='xray_tube', energy=60.0, focal_spot='.6, .1', focal_order=8), None, 0.6**2 / 12),
        (None, detector(psf=0.3), 0.3**2 / (8 * np.log(2))),
        (
            dict(type='xray_tube', energy=60.0, focal_spot='.6', focal_order=8),
            detector(psf=0.3),
            0.03 + 0.09 / (8 * np.log(2)),
        ),
    ],
)
def test_edge_responses(tube, film, variance):
    """Magnified twice, a uniform spot of width w is a box of width w (DSD - DSO) / DSO = w at the panel; variances add."""
    mean, measured = edge_moments(tube, film) if film is None else edge_moments(tube, film, 0.01, 400)
    assert abs(mean) < 0.003 and abs(measured / variance - 1) < 0.01


@pytest.mark.parametrize('pixel', ['centre', 3, 'area'])
def test_aperture_is_the_mean_over_a_pixel(pixel):
    """The mean is taken once, whatever the integrator's own rule for pixels."""
    soft = scene_of(None, None, detector(aperture=1.0, aperture_order=8), pixel=pixel)
    fine = scene_of(pixel=16, output='transmission')
    np.testing.assert_allclose(render(soft), -np.log(render(fine)), atol=2e-4)


# ---- noise and scans -------------------------------------------------------------------------------------------------


def test_noise_follows_seed_and_view():
    scene = scene_of(None, None, detector(photons=1e3))
    first, again, other = (np.array(mi.render(scene, seed=s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01
    p = render(scene_of()).ravel()
    assert abs(np.mean((first.ravel() - p) ** 2 * 1e3 * np.exp(-p)) - 1) < 4 * np.sqrt(2 / len(p)) + 0.02


@physics
def test_scan_of_a_scene(scene_file):
    """Every view is what `mi.render` gives, and the same whichever views are chosen."""
    loaded = load_scene(scene_file())
    every, some = take_scan(loaded, seed=3), take_scan(loaded, 3, seed=3)
    np.testing.assert_array_equal(some.train.projections, every.train.projections[::2])
    np.testing.assert_array_equal(some.test.projections, every.test.projections)
    for i in (0, 3):
        image = np.array(mi.render(loaded.scene, sensor=loaded.scanner.view(i), seed=3))[..., 0]
        np.testing.assert_allclose(every.train.projections[i], image, atol=1e-6)


# ---- errors ----------------------------------------------------------------------------------------------------------


@physics
@pytest.mark.parametrize(
    'old, new, match',
    [
        ('value="120"', 'value="0"', "line 18: xray_tube 'tube': kvp must be from 20 to 300 kV, not 0"),
        ('value="1e4"', 'value="-5"', 'line 16: ct_detector .*photons must be a number from 0'),
        ('<string name="material" value="soft tissue"/>', '', "scene.xml: xray_tube: the shape 'foot' has no material"),
        ('value="soft tissue"', 'value="stone"', "line 18: xray_tube 'tube': the material 'stone' is unknown"),
        ('value="soft tissue"', 'value="soft tissue + bone"', 'need a split'),
        ('name="kvp"', 'name="angle"', 'either an energy or a kvp'),
        (
            '<string name="material"',
            '<string name="focal_spot" value="100"/><string name="material"',
            "xray_tube 'tube': focal_spot of 100 mm is not smaller than the distance of the source, 100 mm",
        ),
        ('name="photons"', 'name="photon"', 'photon'),
        ('name="material"', 'name="material_fooot"', "'tube': material_fooot names none of the shapes foot, volume"),
    ],
)
def test_one_line_that_names_element_and_place(scene_file, old, new, match):
    assert XML.count(old) == 1
    with pytest.raises(InputError, match=match) as caught:
        take_scan(load_scene(scene_file(XML.replace(old, new))))
    assert '\n' not in str(caught.value) and 'scene.xml' in str(caught.value)


def test_a_panel_has_no_crop_window():
    film = detector(width=40, height=30, crop_offset_x=5, crop_offset_y=0, crop_width=20, crop_height=30)
    with pytest.raises(RuntimeError, match='cannot have a crop window'):
        load(dict(cloud=ellipsoids(cloud_of())), dict(type='perspective', film=film))


@physics
def test_second_material_of_a_mesh():
    tube = dict(TUBE, material='soft tissue + bone', split='0.3, 0.7')
    for shape, match in ((block(), 'cannot be of two materials'), (ellipsoids(cloud_of()), 'no attribute "second"')):
        scene = scene_of(dict(box=shape), tube)
        with pytest.raises(InputError, match=match):
            through_mitsuba(scene)


@pytest.mark.parametrize('share', [1.5, -0.5, np.nan])
def test_second_material_is_a_share(share):
    cloud = ellipsoids(cloud_of())
    cloud['second'] = mi.TensorXf(np.full((len(cloud_of().density), 1), share, np.float32))
    with pytest.raises(InputError, match='is a share in the density, from 0 to 1'):
        through_mitsuba(scene_of(dict(box=cloud)))


@physics
def test_materials_of_shapes_in_a_cloud():
    """The material that attenuates less comes first, in whatever order shapes name materials."""
    tubes = [
        Tube.of(TubeParameters(kvp=120.0, split='.04, .09', material=one, materials=dict(a=other)))
        for one, other in (('Al', 'water'), ('water', 'Al'))
    ]
    for tube in tubes:
        assert tube.fitted() == tube.of_cloud().materials_of('cloud') == ('water', 'Al')


@physics
def test_simulated_noise_is_not_subtracted(scene_file):
    """The rest after linearising is the error of expected views, whatever noise the effects have."""
    loaded = load_scene(scene_file(XML.replace('value="1e4"', 'value="100"')))
    scan, objects = take_scan(loaded).train, find_objects(loaded.scene)
    effects = scan.effects
    quiet = replace(effects, detector=effects.detector.expected)
    actual, wanted = (corrected(scan, e, objects).projections for e in (effects, quiet))
    np.testing.assert_array_equal(actual, wanted)


def test_dead_pixels_that_are_left_in_are_filled():
    detector = Detector.of(**(Detector.DEFAULTS | dict(dead=0.05, corrected=False)))
    geometry = lm.Geometry.parallel(nDetector=(20, 24), dDetector=1, nVoxel=8, dVoxel=1, angles=[0.0, 1.0])
    view = np.add.outer(np.arange(20), np.arange(24)) / 50
    seen = np.stack([detector.measure(np.exp(-view), i) for i in range(2)])
    effects = Effects(detector=detector)
    dead = detector.maps((20, 24))[1]
    assert dead.any() and seen[:, dead].min() > 10
    projections = line_integrals(lm.Scan(geometry, seen, effects=effects)).projections
    np.testing.assert_allclose(projections, np.broadcast_to(view, projections.shape), atol=0.05)


def test_a_focal_spot_needs_a_panel_in_millimetres():
    camera = dict(type='perspective', to_world=mi.ScalarTransform4f().look_at([0, 0, -5], [0, 0, 0], [0, 1, 0]))
    scene = mi.load_dict(dict(type='scene', tube=dict(type='xray_tube', energy=60.0, focal_spot='0.5'), camera=camera))
    with pytest.raises(InputError, match='focal_spot, in mm, needs a ct_scanner'):
        find_effects(scene, scene.sensors()[0])


def test_gains_that_are_left_in_move_the_saturation():
    detector = Detector.of(**(Detector.DEFAULTS | dict(gain=0.2, saturation=0.5, corrected=False)))
    gains = detector.maps((8, 9))[0]
    clipped = detector.signal(np.full((8, 9), 0.5), 0) >= 0.5  # of what the detector measures
    np.testing.assert_array_equal(clipped, -np.log(0.5) <= detector.saturates((8, 9)) + 1e-12)
    assert clipped.any() and not clipped.all() and (gains[clipped] >= 1).all()


def test_views_too_bright_to_be_counted():
    detector = Detector.of(**(Detector.DEFAULTS | dict(photons=1e5)))
    with pytest.raises(InputError, match='brighter than can be counted'):
        detector.measure(np.full((2, 2), np.exp(40.0)), 0)


@physics
def test_seeds_of_mitsubas_own_type(scene_file):
    scene = load_scene(scene_file()).scene
    same = [np.array(mi.render(scene, seed=seed)) for seed in (3, mi.UInt32(3))]
    np.testing.assert_array_equal(*same)
