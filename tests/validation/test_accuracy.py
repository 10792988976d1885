"""The integrator's knobs, the float64 truth of `closed_form`, the other methods, and the measurements of `accuracy`."""

import json
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.same import assert_same
from helpers.script import run
from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.projectors.cutoff import PRESETS
from lingo_mi.validation import alternatives, oracle
from lingo_mi.validation.accuracy import Sizes, measure, measure_presets
from lingo_mi.validation.accuracy.compare import by_function, by_integrator, compare, deviation
from lingo_mi.validation.accuracy.report import write
from lingo_mi.validation.accuracy.tables import BACKWARD, SHOWN, TITLES, make_tables, read_presets
from lingo_mi.validation.accuracy.workload import Workload
from lingo_mi.validation.closed_form import NAMES, image_and_gradients, rays_and_gradients
from lingo_mi.validation.oracle import random_cloud, relative

ROOT = Path(__file__).parents[2]
TINY = Sizes(
    gaussians=40,
    few=20,
    pixels=32,
    box=60.0,
    grids=(16,),
    rounds=1,
    seconds=0.1,
    pairs=(1e3, 1e4),
    counts=(10, 100),
    panels=(16, 32),
    crowd=30,
    phantoms=(16,),
    points=(50, 100),
    iterations=(3, 6),
    views=4,
    samples=(8, 16),
    field_pixels=4,
)


@pytest.fixture(scope='module')
def cone(variant):
    return Workload(200, 96, 120.0)


@pytest.fixture(scope='module')
def parallel(variant):
    return Workload(200, 96, 120.0, mode='parallel')


def errors(work, **settings):
    """Relative errors of the image and of each derivative by `lingo_xray` with these parameters."""
    method = by_integrator('', work, **settings)
    image, gradients = work.truth
    out = dict(image=relative(method.image(), image))
    return out | {k: relative(np.array(g).T, gradients[k]) for k, g in zip(NAMES, method.gradients())}


def render(work, **settings):
    return np.array(by_integrator('', work, **settings).image())


# ------------------------------------------------------------------------------------------------------------
#  Truth
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_closed_form_is_the_oracle(mode):
    rng = np.random.default_rng(3)
    g = CircularGeometry(
        DSO=5,
        DSD=7.5,
        nDetector=(20, 27),
        dDetector=(0.15, 0.16),
        angles=[0.4],
        offDetector=(0.1, -0.2),
        mode=mode,
        grid=Grid(8, 0.25),
    )
    cloud, weights = random_cloud(rng, 4, size=0.06), rng.normal(size=(20, 27))
    columns = cloud.centre, cloud.scale, cloud.rotation, cloud.density
    image, gradients = image_and_gradients(columns, g.rays(), (20, 27), weights)
    pose = oracle.Pose.of(g.rays(), 0, 20, 27)
    assert relative(image, oracle.line_integrals(cloud, pose)) < 1e-12
    expected = oracle.gradients(cloud, pose, weights.ravel())
    on_rays, by = rays_and_gradients(columns, *pose.rays(), weights.ravel())
    assert relative(on_rays, image) < 1e-12
    for name in NAMES:
        assert relative(gradients[name], expected[name]) < 1e-9
        assert relative(by[name], expected[name]) < 1e-9


def test_pixel_mean_of_the_truth(cone):
    """Gauss-Legendre points agree with 12 x 12 rays a pixel."""
    columns, frames = [x[:5] for x in cone.columns], cone.geometry.rays()
    mean, _ = image_and_gradients(columns, frames, (96, 96), order=4)
    fine = replace(frames, u=frames.u / 12, v=frames.v / 12)
    fine, _ = image_and_gradients(columns, fine, (96 * 12, 96 * 12))
    assert relative(fine.reshape(96, 12, 96, 12).mean((1, 3)), mean) < 1e-3
    assert relative(image_and_gradients(columns, frames, (96, 96), order=5)[0], mean) < 1e-8


# ------------------------------------------------------------------------------------------------------------
#  Knobs
# ------------------------------------------------------------------------------------------------------------


def test_affine_footprint(cone):
    exact, affine = errors(cone, extent=7.0), errors(cone, extent=7.0, footprint='affine')
    assert max(exact.values()) < 3e-6
    assert 3e-4 < affine['image'] < 2e-2
    assert all(1e-3 < affine[name] < 0.1 for name in NAMES)


def test_affine_is_exact_in_parallel_beams(parallel):
    assert_same(render(parallel, footprint='affine'), render(parallel))


def test_affine_adds_no_kernel(cone):
    """Both models run the same kernels, so that neither pays for the other."""

    def kernels(footprint):
        render(cone, footprint=footprint)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            render(cone, footprint=footprint)
            return {k['hash'] for k in dr.kernel_history([dr.KernelType.JIT])}

    exact, affine = kernels('exact'), kernels('affine')
    assert len(exact & affine) >= len(exact) - 1  # but for the one that packs footprints


@pytest.mark.parametrize('output', ['line_integral', 'transmission'])
def test_pixel_quadrature_converges(variant, output):
    """The error falls by a factor of four from n to 2 n: a midpoint rule."""
    work = Workload(60, 64, 80.0, order=4)

    def image(n):
        errors_of = render(work, extent=7.0, pixel=n, output=output)
        return 1 - errors_of if output == 'transmission' else errors_of

    expected = work.truth[0].ravel() if output == 'line_integral' else image(16)
    errors_of = [relative(image(n), expected) for n in ('centre', '2', 4)]
    assert 1e-3 < errors_of[0] < 0.1
    for coarse, fine in zip(errors_of, errors_of[1:]):
        assert 3 < coarse / fine < 5


def test_pixel_gradients(variant):
    work = Workload(60, 64, 80.0, order=4)
    coarse, fine = errors(work, extent=7.0), errors(work, extent=7.0, pixel=4)
    assert all(fine[name] < coarse[name] / 8 for name in NAMES)


@pytest.mark.parametrize('mode', ['cone', pytest.param('parallel', marks=pytest.mark.thorough)])
def test_pixel_area(variant, mode):
    """It is better than 4 x 4 rays if the Gaussians are wider than a pixel, and its error falls nearly with the fourth power of
    the size."""
    coarse, fine = (Workload(60, 64 * k, 80.0 * k**2, order=6, mode=mode) for k in (1, 2))
    actual, rays = errors(fine, extent=8.0, pixel='area'), errors(fine, extent=8.0, pixel=4)
    assert all(actual[name] < 0.8 * rays[name] for name in actual)
    assert actual['image'] < 2e-4 and errors(coarse, extent=8.0, pixel='area')['image'] / actual['image'] > 8


def test_pixel_area_of_a_pixel_wide_ridge(variant):
    """The Gaussian is far longer than wide, along the rows. Its profile across is the box's convolution, which is exactly
    known."""
    from scipy.special import erf

    sigma, step = 0.05, 0.1  # one pixel of the plane through the centre, two at the panel
    scene = mi.load_dict(
        dict(
            type='scene',
            scanner=dict(
                type='ct_scanner',
                mode='parallel',
                DSO=5,
                DSD=7,
                nDetector='33',
                dDetector=str(step),
                nVoxel='8',
                dVoxel='.5',
                angles='0',
            ),
            cloud=dict(
                type='ellipsoids',
                data=mi.TensorXf(np.float32([[0, 0, 0, 0.4, 40, sigma, 0, 0, 0, 1]])),
                density=mi.TensorXf(np.float32([[1]])),
            ),
        )
    )
    image = mi.render(scene, integrator=mi.load_dict(dict(type='lingo_xray', extent=8, pixel='area'))).numpy()[..., 0]
    z = (np.arange(33) - 16) * step
    integral = 0.4 * np.sqrt(2 * np.pi)
    mean = (
        integral
        * sigma
        * np.sqrt(np.pi / 2)
        / step
        * (erf((z + step / 2) / sigma / np.sqrt(2)) - erf((z - step / 2) / sigma / np.sqrt(2)))
    )
    assert abs(image[:, 16] - mean).max() < 0.05 * mean.max()  # of half a pixel's width, where it is at its worst
    assert abs(image[:, 16].sum() / mean.sum() - 1) < 4e-3  # aliasing of the wider Gaussian, 2 exp(-2 pi^2 / 3)
    centre = mi.render(scene, integrator=mi.load_dict(dict(type='lingo_xray', extent=8))).numpy()[..., 0]
    assert abs(centre[:, 16] - mean).max() > 0.1 * mean.max() and abs(centre[:, 16].sum() / mean.sum() - 1) > 0.01


def test_pixel_of_other_objects(variant):
    """A grid with 2 x 2 rays a pixel is the mean of four pixels half the size."""
    cube = dict(
        type='cube',
        bsdf=dict(type='null'),
        interior=dict(type='homogeneous', sigma_t=1.0, albedo=0.0),
        to_world=mi.ScalarTransform4f().rotate([1, 2, 3], 40).scale(0.3),
    )
    scanner = dict(type='ct_scanner', DSO=5, DSD=7.5, nVoxel='8', dVoxel='.25')

    def image(count, side, **settings):
        return np.array(
            mi.render(
                mi.load_dict(
                    dict(
                        type='scene',
                        cube=cube,
                        integrator=dict(type='lingo_xray', **settings),
                        scanner=dict(scanner, nDetector=f'{count}', dDetector=f'{side}'),
                    )
                )
            )
        )[..., 0]

    expected = image(40, 0.05).reshape(20, 2, 20, 2).mean((1, 3))
    np.testing.assert_allclose(image(20, 0.1, pixel=2), expected, rtol=1e-5, atol=1e-6)
    with pytest.raises(InputError, match='ellipsoids alone'):
        image(20, 0.1, pixel='area')


def test_presets(cone):
    for name, extent in PRESETS.items():
        assert_same(render(cone, accuracy=name), render(cone, extent=extent))
    assert_same(render(cone), render(cone, accuracy='default'))
    assert_same(render(cone, accuracy='draft', extent=6.0), render(cone, extent=6.0))
    values = [errors(cone, accuracy=name) for name in PRESETS]
    for better, limits in zip(values, ((2e-2, 0.2), (1e-5, 2e-4), (1e-6, 3e-6))):
        assert better['image'] < limits[0] and max(better.values()) < limits[1]


@pytest.mark.parametrize(
    'settings',
    [
        dict(accuracy='best'),
        dict(footprint='ewa'),
        dict(pixel=0),
        dict(pixel='middle'),
        dict(pixel=2.5),
        dict(pixel=17),
        dict(extent=0.5),
    ],
)
def test_unknown_values_are_refused(settings):
    with pytest.raises(RuntimeError) as error:
        mi.load_dict(dict(type='lingo_xray', **settings))
    line = next(line for line in str(error.value).splitlines() if 'InputError: lingo_xray: ' in line)
    assert next(iter(settings)) in line


# ------------------------------------------------------------------------------------------------------------
#  Other methods
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('precision, limit', [('float32', 5e-5), ('compensated', 5e-5), ('float64', 1e-6)])
@pytest.mark.parametrize('beam', ['cone', 'parallel'])
def test_every_gaussian_on_every_ray(beam, precision, limit, request):
    work = request.getfixturevalue(beam)
    method = by_function(
        '', work, lambda *x: alternatives.per_ray(*x, work.view, precision), precision != 'compensated'
    )
    image, gradients = work.truth
    assert deviation(np.array(method.image()), image)[0] < (1e-12 if precision == 'float64' else limit)
    if method.gradients:
        for name, actual in zip(NAMES, method.gradients()):
            assert relative(np.array(actual).T, gradients[name]) < limit


def test_march_of_a_constant():
    """It gives the chords of a cube, up to a step at its ends."""
    data = dr.ones(mi.Float, 8**3)
    dr.make_opaque(data)
    origin, direction = mi.Point3f([-3, -3], [0, 0], [0, 0.4]), mi.Vector3f([1, 1], [0, 0.1], [0, 0])
    actual = alternatives.march(data, 8, 1.0, origin, direction / dr.norm(direction), 0.002).numpy()
    np.testing.assert_allclose(actual, [2, 2 * np.hypot(1, 0.1)], atol=0.004)


@pytest.mark.traces_rays
def test_tree_of_one_gaussian(variant):
    """With one Gaussian and a generous epsilon, marching has nothing to miss."""
    work = Workload(1, 48, 200.0)
    tree = alternatives.Tree(work.data, work.density, 6.0, 1e-2)
    rays = alternatives.rays(work.view, 2.0)
    image, gradients = work.truth
    assert relative(tree.image(*rays), image) < 1e-5
    by_data, by_density = tree.gradients(*rays, mi.Float(work.weights.ravel()))
    for name, part in zip(NAMES, (*np.split(np.array(by_data), (3, 6)), np.array(by_density))):
        assert relative(part, gradients[name]) < 2e-3, name


# ------------------------------------------------------------------------------------------------------------
#  Measurements
# ------------------------------------------------------------------------------------------------------------


def test_compare(cone):
    (row,) = compare(cone, [by_integrator('5', cone, extent=5.0)], TINY)
    assert row['name'] == '5' and row['image'] < 1e-5 and row['image_max'] < 1e-5
    assert all(row[name] < 1e-4 and row[f'{name}_max'] < 1e-4 for name in NAMES)
    assert row['forward_ms'] > 0 and row[f'{BACKWARD}_ms'] > 0 and row['memory_mb'] > 0


def test_presets_are_described_as_measured(variant):
    """The plugin's docstring gives, rounded, what the table in the documentation says."""
    text = (ROOT / 'docs' / 'accuracy.md').read_text(encoding='utf-8')
    rows = text.split('<!-- table presets -->\n')[1].split('<!-- end presets -->')[0].splitlines()[2:]
    measured = {}
    for row in rows:
        cells = [cell.strip(' `') for cell in row.strip('|').split('|')]
        name, extent, image, *derivatives, image_cuda, worst_cuda, forward, gradients = cells
        # More is rounded where all add to one image, which shows where nothing is cut off.
        assert float(image_cuda) < 4 * float(image)
        assert float(worst_cuda) < 1.5 * max(map(float, derivatives))
        measured[name] = [
            extent,
            *(f'{x:.0e}' for x in (float(image), max(map(float, derivatives)))),
            *(f'{float(x):.1f}' for x in (forward, gradients)),
        ]
    words = type(mi.load_dict(dict(type='lingo_xray'))).__doc__.splitlines()
    described = {
        line.split()[0].strip('`'): line.split()[1:]
        for line in words
        if line.split()[:1] and line.split()[0].strip('`') in PRESETS and len(line.split()) == 6
    }
    assert described == measured and list(measured) == list(PRESETS)


@pytest.mark.thorough
def test_presets_of_two_variants(tmp_path, monkeypatch):
    """The command measures the presets alone. Their table, with another run's errors, replaces the document's table."""
    actual = measure_presets(TINY)
    other = json.loads(json.dumps(actual))
    other['conditions']['variant'] = 'cuda_ad_mono'
    other['cutoff'][0].update(image=0.123, rotation=4.56)
    there, document = tmp_path / 'there.json', tmp_path / 'accuracy.md'
    there.write_text(json.dumps(other))
    document.write_text('<!-- table presets -->\nold\n<!-- end presets -->\n')
    monkeypatch.setattr('lingo_mi.validation.accuracy.measure_presets', lambda *_: actual)
    script, out = ROOT / 'scripts' / 'accuracy.py', tmp_path / 'out'
    code, printed, err = run(script, '--presets', '--beside', there, '--out', out, '--document', document)
    assert code == 0 and 'accuracy.json' in printed, err
    head, _, draft, *rest = (line for line in document.read_text().splitlines() if line.startswith('|'))
    cells = dict(zip(head.split(' | '), draft.split(' | ')))
    assert cells['image, L2, CUDA'] == '1.2e-01' and cells['worst ∂, CUDA'] == '4.6e+00' and len(rest) == 2
    assert read_presets(out / 'accuracy.json')['cutoff'] == actual['cutoff'] and not list(tmp_path.rglob('*.png'))
    there.write_text('{"cutoff": []}')
    code, _, err = run(script, '--presets', '--beside', there, '--out', out)
    assert code == 2 and 'holds no presets' in err


@pytest.mark.thorough
@pytest.mark.traces_rays
def test_whole_measurement(tmp_path, monkeypatch):
    """Every part runs on a tiny configuration, down to the documentation, by the function and by the command."""
    parts = []
    actual = measure(TINY, parts.append)
    assert len(parts) == len(actual) - 1
    document = tmp_path / 'accuracy.md'
    document.write_text((ROOT / 'docs' / 'accuracy.md').read_text(encoding='utf-8'), encoding='utf-8')
    write(actual, tmp_path / 'out', tmp_path / 'figures', document)
    for name in ('pareto', 'scaling', 'fits'):
        assert 5_000 < (tmp_path / 'figures' / f'{name}.png').stat().st_size < 150_000
    tables = make_tables(actual)
    assert list(tables) == list(TITLES)
    text = document.read_text(encoding='utf-8')
    assert all(tables[name] in text for name in SHOWN)
    assert (tmp_path / 'out' / 'accuracy.provenance.json').exists() and (tmp_path / 'accuracy.provenance.json').exists()
    monkeypatch.setattr('lingo_mi.validation.accuracy.measure', lambda *_: actual)
    script, docs = ROOT / 'scripts' / 'accuracy.py', tmp_path / 'docs'
    docs.mkdir()
    (docs / 'accuracy.md').write_text('\n'.join(f'<!-- table {name} -->\n<!-- end {name} -->\n' for name in SHOWN))
    code, printed, err = run(script, '--out', tmp_path / 'alone')
    assert code == 0 and 'pareto.png' in printed, err
    assert (tmp_path / 'alone' / 'fits.png').exists() and not (docs / 'figures').exists()
    code, _, err = run(script, '--out', tmp_path / 'other', '--docs', docs)
    assert code == 0, err
    assert tables['presets'] in (docs / 'accuracy.md').read_text() and (docs / 'figures' / 'fits.png').exists()
    assert (
        '--docs' in (docs / 'accuracy.provenance.json').read_text() and not (tmp_path / 'other' / 'fits.png').exists()
    )


def test_script_describes_itself():
    code, out, _ = run(ROOT / 'scripts' / 'accuracy.py', '--help')
    assert code == 0 and '--quick' in out
