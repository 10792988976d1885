"""Scattered photons: the phase functions, single scattering against an integral, all orders against photons followed one by
one, and what a scene makes of them."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba import chi2

from helpers.circles import circle
from helpers.effects import XML
from helpers.scenes import SCANNER, block, cloud_of, ellipsoids, grid, load, render, values_of
from lingo_mi.common.errors import InputError
from lingo_mi.effects.compton import CELLS, klein_nishina, scattering
from lingo_mi.effects.forward import find_effects
from lingo_mi.effects.hardening import Tube, TubeParameters
from lingo_mi.effects.scatter import Scatter, _energies, smoothed
from lingo_mi.effects.spectrum import attenuation, tube_spectrum
from lingo_mi.projectors.objects import GridInCube, find_objects
from lingo_mi.projectors.sampling import bounds, on_grid
from lingo_mi.projectors.sensors import view_of
from lingo_mi.projectors.view import View
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import take_scan

xraylib = pytest.importorskip('xraylib', reason="needs pip install 'lingo_mi[physics]'")
pytest.importorskip('spekpy', reason="needs pip install 'lingo_mi[physics]'")
COSINE = np.linspace(-1, 1, CELLS + 1)
R_E2 = 79.40787e-3  # classical electron radius squared, barn


# ---- phase functions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('energy', [1.0, 20.0, 60.0, 300.0, 799.0])
def test_klein_nishina_is_xraylibs(energy):
    expected = [xraylib.DCS_KN(energy, float(np.arccos(c))) for c in COSINE[::512]]
    np.testing.assert_allclose(R_E2 * klein_nishina(COSINE[::512], energy), expected, rtol=1e-5)
    table, total = scattering(energy)
    assert abs(R_E2 * total / xraylib.CS_KN(energy) - 1) < 1e-5
    middles = (COSINE[1:] + COSINE[:-1]) / 2
    np.testing.assert_allclose((table[1:] + table[:-1]) / 2, klein_nishina(middles, energy), rtol=2e-6)


def test_small_energies_scatter_like_thomson():
    np.testing.assert_allclose(klein_nishina(COSINE, 1e-6), (1 + COSINE**2) / 2, rtol=1e-8)
    table, total = scattering(1.0)
    np.testing.assert_allclose(table / total, 3 / (16 * np.pi) * (1 + COSINE**2), rtol=6e-3)


@pytest.mark.parametrize('material', ['water', 'Fe'])
def test_bound_electrons(material):
    """Coherent and incoherent scattering together have xraylib's total and its distribution of angles."""
    formula, density = dict(water=('Water, Liquid', 1.0), Fe=('Fe', xraylib.ElementDensity(26)))[material]
    table, total = scattering(60.0, material)
    assert (
        abs(total / ((xraylib.CS_Compt_CP(formula, 60.0) + xraylib.CS_Rayl_CP(formula, 60.0)) * density / 10) - 1)
        < 2e-4
    )
    angles = np.arccos(COSINE[:-40:64])
    expected = [xraylib.DCS_Compt_CP(formula, 60.0, a) + xraylib.DCS_Rayl_CP(formula, 60.0, a) for a in angles.tolist()]
    np.testing.assert_allclose(table[:-40:64], np.array(expected) * density / 10, rtol=2e-3)


def test_energy_that_is_kept():
    cosine, weights = np.polynomial.legendre.leggauss(64)
    angles = np.arccos(cosine).tolist()
    energies = [xraylib.DCS_KN(100.0, a) * xraylib.ComptonEnergy(100.0, a) / 100 for a in angles]
    assert abs(R_E2 * scattering(100.0, '', 'energy')[1] / (2 * np.pi * weights @ energies) - 1) < 1e-5


@pytest.mark.parametrize(
    'extra',
    [
        '<float name="energy" value="60"/>',
        '<float name="energy" value="600"/><string name="response" value="energy"/>',
        '<float name="energy" value="40"/><string name="material" value="water"/>',
    ],
)
def test_samples_follow_the_density(extra):
    sample, density = chi2.PhaseFunctionAdapter('klein_nishina', extra)
    test = chi2.ChiSquareTest(
        chi2.SphericalDomain(), sample, density, sample_dim=3, sample_count=200_000, res=51, ires=16
    )
    assert test.run(test_count=3)


@pytest.mark.parametrize(
    'changes, match',
    [
        (dict(energy=0.0), 'energy must be from 1 to 800 keV, not 0'),
        (dict(energy=-60.0), 'not -60'),
        (dict(), 'must be a number'),
        (dict(energy=60.0, material='stone'), "'stone' is unknown"),
        (dict(energy=60.0, response='heat'), 'response must be'),
    ],
)
def test_bad_phase_functions(changes, match):
    with pytest.raises(Exception, match=f'klein_nishina .*{match}'):
        mi.load_dict(dict(type='klein_nishina', **changes))


# ---- single scattering -----------------------------------------------------------------------------------------------

LOW, HIGH = np.array([-40.0, -60, -50]), np.array([60.0, 40, 50])
MU = 0.0205


def geometry(**changes):
    settings = dict(
        DSO=400.0,
        DSD=600.0,
        nDetector=(40, 60),
        dDetector=5.0,
        nVoxel=8,
        dVoxel=25.0,
        angles=[0.3],
        offDetector=(10.0, 20.0),
    )
    return circle(**settings | changes)


def water_box():
    return GridInCube.of(np.full((4, 4, 4), MU, np.float32), LOW, HIGH, 'box')


def tube_of(energy=60.0, material='water', **changes):
    settings = dict(
        energy=energy,
        kvp=None,
        angle=12.0,
        filtration='',
        reference=60.0,
        material=material,
        split='',
        bands=4,
        materials={},
    )
    return Tube.of(TubeParameters(**settings | changes))


def chord(a, b):
    """Length of the straight line from a to b inside the box, arrays [..., 3]."""
    along = b - a
    with np.errstate(divide='ignore'):
        first, second = (LOW - a) / along, (HIGH - a) / along
    enter = np.minimum(first, second).max(-1).clip(0, 1)
    leave = np.maximum(first, second).min(-1).clip(0, 1)
    return np.maximum(leave - enter, 0) * np.linalg.norm(along, axis=-1)


def pose(g):
    frames = g.rays()
    return [np.asarray(a[0], float) for a in (frames.source, frames.corner, frames.u, frames.v)]


def single(g, points, order=28):
    """Photons scattered once at the points [n, 3] of a panel, over the open beam's: an integral over the box in float64."""
    source, corner, u, v = pose(g)
    parallel, normal = g.mode == 'parallel', np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    x, w = np.polynomial.legendre.leggauss(order)
    axes = ((LOW + HIGH) / 2 + x[:, None] * (HIGH - LOW) / 2).T
    where = np.stack(np.meshgrid(*axes, indexing='ij'), -1).reshape(-1, 3)
    weights = np.einsum('i,j,k->ijk', w, w, w).ravel() * np.prod(HIGH - LOW) / 8
    start = where - 1e4 * source if parallel else source
    into = where - start
    distance = np.linalg.norm(into, axis=1)
    # Lit is what lies between the source and the panel.
    hit = start + ((corner - start) @ normal / (into @ normal))[:, None] * into - corner
    column, row = hit @ u / (u @ u), hit @ v / (v @ v)
    lit = (column > 0) & (column < g.nDetector[1]) & (row > 0) & (row < g.nDetector[0])
    half = np.linspace(0, 1, 3001) ** 2
    angles = (2 * np.arcsin(np.maximum(half, 1e-3))).tolist()
    density = [(xraylib.DCS_Compt_CP('H2O', 60.0, a) + xraylib.DCS_Rayl_CP('H2O', 60.0, a)) for a in angles]
    density = np.array(density) / 10 * MU / attenuation('water', [60.0])[0]
    out = []
    for point in points:
        off = point - where
        length = np.linalg.norm(off, axis=1)
        cosine = (into * off).sum(1) / distance / length
        scattered = np.interp(np.sqrt((1 - cosine) / 2), half, density)
        light = lit * scattered * np.exp(-MU * (chord(start, where) + chord(where, point)))
        light *= np.abs(off @ normal) / length**3 / (1 if parallel else distance**2)
        beam = source if parallel else point - source
        out.append(weights @ light * (1 if parallel else np.linalg.norm(beam) ** 3) / abs(beam @ normal))
    return np.array(out)


@pytest.mark.traces_rays
@pytest.mark.parametrize('changes', [dict(), dict(offDetector=(0.0, 130.0)), dict(mode='parallel')])
def test_single_scattering(changes):
    """For a cone, a panel that sees half of the box, and parallel rays, every point is within its error, and the mean within
    1.5 %."""
    g = geometry(**changes)
    view = View.of(g.rays(), 0, *g.nDetector)
    means, errors = Scatter(2**15, (4, 4), orders=1, energies=1).estimate([water_box()], tube_of(), 'count', view, 0)
    _, corner, u, v = pose(g)
    points = [corner + 20 * i * u + 40 / 3 * j * v for j in range(4) for i in range(4)]
    # Where the collimator's edge cuts the box Gauss's rule converges slowly.
    expected = single(g, points, 80 if g.offDetector[1] == 130 else 28).reshape(4, 4)
    off = (means - expected) / errors
    assert np.sum(off**2) < 45 and abs(off.mean()) < 1.2  # 16 degrees of freedom with a t distribution: 1 in 1000
    assert errors.mean() / means.mean() < 0.04 and abs(means.sum() / expected.sum() - 1) < 0.015


# ---- all orders ------------------------------------------------------------------------------------------------------


def photons(g, count, rng):
    """Photons followed from the source through the box until they leave it: the share of those aimed at the panel that reach it
    scattered, and its standard error."""
    source, corner, u, v = pose(g)
    rows, columns = g.nDetector
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    at = corner + rng.random((count, 1)) * columns * u + rng.random((count, 1)) * rows * v
    direction = at - source
    far = np.linalg.norm(direction, axis=1, keepdims=True)
    direction /= far
    weight = np.abs(direction @ normal) / far[:, 0] ** 2  # solid angle of the panel's area
    open_beam = weight.sum()
    fine = np.linspace(-1, 1, 20001)
    table = np.interp(fine, COSINE, scattering(60.0, 'water')[0])
    rising = np.concatenate([[0], np.cumsum((table[1:] + table[:-1]) / 2)])
    share = scattering(60.0, 'water')[1] / attenuation('water', [60.0])[0]
    with np.errstate(divide='ignore'):
        enter = np.minimum((LOW - source) / direction, (HIGH - source) / direction).max(1)
        leave = np.maximum((LOW - source) / direction, (HIGH - source) / direction).min(1)
    inside = leave > enter
    position, direction, weight = (source + enter[:, None] * direction)[inside], direction[inside], weight[inside]
    arrived = []
    for order in range(40):
        with np.errstate(divide='ignore'):
            leave = np.maximum((LOW - position) / direction, (HIGH - position) / direction).min(1)
        free = rng.exponential(1 / MU, len(position))
        out = free > leave
        if order:
            towards = (corner - position[out]) @ normal / (direction[out] @ normal)
            hit = position[out] + towards[:, None] * direction[out] - corner
            column, row = hit @ u / (u @ u), hit @ v / (v @ v)
            arrived.append(weight[out][(towards > 0) & (column > 0) & (column < columns) & (row > 0) & (row < rows)])
        position, direction, weight = (
            (position + free[:, None] * direction)[~out],
            direction[~out],
            weight[~out] * share,
        )
        cosine = np.interp(rng.random(len(position)) * rising[-1], rising, fine)
        angle, sine = 2 * np.pi * rng.random(len(position)), np.sqrt(1 - cosine**2)
        across = np.cross(direction, np.eye(3)[np.abs(direction).argmin(1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        direction = (
            cosine[:, None] * direction
            + (sine * np.cos(angle))[:, None] * across
            + (sine * np.sin(angle))[:, None] * np.cross(direction, across)
        )
    arrived = np.concatenate(arrived)
    return arrived.sum() / open_beam, np.sqrt((arrived**2).sum()) / open_beam


@pytest.mark.traces_rays
def test_all_orders():
    """The scattered photons of a whole panel agree within 3 standard errors of both; those scattered once are far fewer."""
    g = geometry(DSD=480.0, dDetector=(7.0, 6.0))
    view = View.of(g.rays(), 0, *g.nDetector)
    expected, error = photons(g, 400_000, np.random.default_rng(0))
    results = {}
    for orders in (1, -1):
        means, errors = Scatter(4096, (12, 12), orders, energies=1).estimate([water_box()], tube_of(), 'count', view, 0)
        source, corner, u, v = pose(g)
        x, w = np.arange(12) / 11, np.where(np.arange(12) % 11 == 0, 0.5, 1)  # the trapezoid rule
        beam = corner + (60 * x)[:, None] * u + (40 * x)[:, None, None] * v - source
        share = np.linalg.norm(beam, axis=-1) ** -3.0 * w * w[:, None]
        share /= share.sum()
        results[orders] = (means * share).sum(), np.sqrt((errors**2 * share**2).sum())
    assert error < 0.02 * expected and results[-1][1] < 0.02 * expected
    assert abs(results[-1][0] - expected) < 3 * np.hypot(error, results[-1][1])
    assert results[1][0] < 0.8 * expected


@pytest.mark.traces_rays
def test_two_names_of_one_material():
    """A grid of two materials that are in truth one, told apart by density, scatters as much as one material."""
    ramp = np.broadcast_to(np.linspace(0.5, 1.5, 8)[:, None, None] * MU, (8, 8, 8)).astype(np.float32)
    box, g = GridInCube.of(ramp, LOW, HIGH, 'box'), geometry()
    view, s = View.of(g.rays(), 0, *g.nDetector), Scatter(4096, (4, 4), energies=1)
    one, error = s.estimate([box], tube_of(), 'count', view, 0)
    two, other = s.estimate([box], tube_of(material='water + H2O @ 1', split='.015, .025'), 'count', view, 1)
    assert abs(one.mean() - two.mean()) < 4 * np.sqrt((error**2 + other**2).sum()) / 16
    assert error.mean() < 0.1 * one.mean()


# ---- grids and smoothing ---------------------------------------------------------------------------------------------


def test_objects_on_a_grid():
    """No attenuation is lost: integrals over the box agree."""
    scene = load(dict(cloud=ellipsoids(cloud_of()), grid=grid(values_of()), bolt=block(1.3)))
    cloud, values, bolt = sorted(find_objects(scene), key=lambda obj: ('cloud', 'grid', 'bolt').index(obj.name))
    made = cloud_of()
    expected = {
        cloud: (made.density * np.prod(made.scale, 1)).sum() * (2 * np.pi) ** 1.5,
        values: values_of().mean() * 0.8 * 1.0 * 1.2,
        bolt: 1.3 * 8 * abs(np.linalg.det(np.array(block()['to_world'].matrix)[:3, :3])),
    }
    for obj, integral in expected.items():
        low, high = bounds([obj])
        step = (high - low) / 48
        assert abs(on_grid(obj, low, step, (48, 48, 48)).sum() * np.prod(step) / integral - 1) < 0.02
    low, high = bounds([values])
    np.testing.assert_allclose(on_grid(values, low, (high - low) / (5, 4, 6), (5, 4, 6)), values_of(), rtol=1e-6)


def test_smoothing():
    """Noise falls, and a smooth image stays."""
    y, x = np.meshgrid(np.linspace(0, 1, 16), np.linspace(0, 1, 20), indexing='ij')
    v, u = np.meshgrid((np.arange(48) + 0.5) / 48, (np.arange(40) + 0.5) / 40, indexing='ij')
    true = 1 + np.sin(2 * u) * np.cos(1.5 * v)
    means = 1 + np.sin(2 * x) * np.cos(1.5 * y)
    np.testing.assert_allclose(smoothed(means, np.full(means.shape, 1e-6), 48, 40), true, atol=1e-5)
    noisy = means + np.random.default_rng(0).normal(0, 0.1, means.shape)
    assert np.sqrt(np.mean((smoothed(noisy, np.full(means.shape, 0.1), 48, 40) - true) ** 2)) < 0.03


def test_energies():
    spectrum = tube_spectrum(120.0)
    shares = spectrum.detected('energy')
    parts = _energies(spectrum.energies, shares, 3)
    assert (
        sum(w for w, _ in parts) == pytest.approx(1)
        and len(parts) == 3
        and all(abs(w - 1 / 3) < 0.05 for w, _ in parts)
    )
    assert sum(w * e for w, e in parts) == pytest.approx(spectrum.energies @ shares)
    assert _energies(np.array([60.0]), np.ones(1), 3) == [(1.0, 60.0)]


# ---- scenes ----------------------------------------------------------------------------------------------------------

SCATTER = dict(type='xray_tube', energy=60.0, material='water', scatter=256, scatter_grid='4, 5')
PANEL = SCANNER | dict(DSO=400, DSD=600, dDetector='8, 8', offDetector='0')


def body():
    return grid(values_of() * 0.04, mi.ScalarTransform4f().scale(50))


@pytest.mark.traces_rays
def test_a_scene_adds_it_to_the_light():
    ideal, scene = load(dict(body=body()), PANEL), load(dict(body=body(), tube=SCATTER), PANEL)
    sensor = scene.sensors()[0]
    effects = find_effects(scene, sensor)
    scattered = effects.scatter.light(find_objects(scene), effects.tube, 'energy', view_of(sensor), 0).numpy()
    assert scattered.min() > 0.002
    image = render(scene)
    expected = -np.log(np.exp(-render(ideal)) + scattered.reshape(23, 30, 1))
    np.testing.assert_allclose(image, expected, atol=1e-5)
    np.testing.assert_array_equal(render(scene), image)


@pytest.mark.traces_rays
def test_numbers_follow_seed_and_view():
    g = geometry()
    view, box = View.of(g.rays(), 0, *g.nDetector), [water_box()]

    def means(index=0, seed=0):
        return Scatter(64, (4, 4), energies=1, seed=seed).estimate(box, tube_of(), 'count', view, index)[0]

    first = means()
    np.testing.assert_array_equal(means(), first)
    assert np.abs(means(1) - first).min() > 0 and np.abs(means(0, 1) - first).min() > 0


@pytest.mark.traces_rays
def test_scan(scene_file):
    """Every view of a scan is what `mi.render` gives."""
    loaded = load_scene(
        scene_file(
            XML.replace(
                '"kvp" value="120"/>',
                '"kvp" value="120"/> <integer name="scatter" value="32"/><string name="scatter_grid" value="4"/>',
            ).replace('value="1e4"', 'value="0"')
        )
    )
    scan = take_scan(loaded, 2)
    image = np.array(mi.render(loaded.scene, sensor=loaded.scanner.view(3)))[..., 0]
    np.testing.assert_allclose(scan.train.projections[1], image, atol=1e-5)


@pytest.mark.parametrize(
    'parameters, match',
    [
        ('<integer name="scatter" value="-1"/>', "line 18: xray_tube 'tube': scatter must be a whole number from 0 to"),
        (
            '<integer name="scatter" value="9"/><string name="scatter_grid" value="2"/>',
            'scatter_grid must be one or two whole',
        ),
        (
            '<integer name="scatter" value="9"/><integer name="scatter_orders" value="0"/>',
            'scatter_orders must be positive',
        ),
        ('<integer name="scatter" value="9"/><integer name="scatter_energies" value="0"/>', 'scatter_energies must be'),
        (
            '<integer name="scatter" value="9"/><string name="scatter_box" value="0,0,0,1,1"/>',
            'scatter_box must be x, y, z',
        ),
        (
            '<integer name="scatter" value="9"/><string name="scatter_box" value="0,0,0,1,1,0"/>',
            'scatter_box must be x, y, z',
        ),
        ('<integer name="scatter" value="9"/><string name="scatter_voxels" value="many"/>', 'scatter_voxels must be'),
        (
            '<integer name="scatter" value="1048576"/><string name="scatter_grid" value="256"/>',
            'take too much memory: give at most 8192 paths',
        ),
    ],
)
def test_one_line_that_names_element_and_place(scene_file, parameters, match):
    with pytest.raises(InputError, match=match) as caught:
        load_scene(scene_file(XML.replace('<string name="material"', parameters + '<string name="material"')))
    assert '\n' not in str(caught.value)


def test_refusals():
    camera = dict(type='perspective', film=dict(type='hdrfilm', width=8, height=8))
    with pytest.raises(InputError, match="xray_tube 'tube': scatter needs a ct_scanner"):
        scene = load(dict(body=body(), tube=SCATTER), camera)
        find_effects(scene, scene.sensors()[0])
    with pytest.raises(InputError, match='box of the objects reaches the panel'):
        g = geometry(DSD=410.0)
        Scatter(16).estimate([water_box()], tube_of(), 'count', View.of(g.rays(), 0, *g.nDetector), 0)
    with pytest.raises(InputError, match="'box' has no material"):
        g = geometry()
        Scatter(16).estimate([water_box()], tube_of(material=''), 'count', View.of(g.rays(), 0, *g.nDetector), 0)
