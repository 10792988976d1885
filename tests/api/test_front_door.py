"""`import lingo_mi as lm`: what it names, what it loads, and a fit from nothing to files and back."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.geometry import circular

SCANNER = dict(DSO=100, DSD=150, nDetector=(24, 30), dDetector=(2, 2), nVoxel=(20,) * 3, dVoxel=(1.2,) * 3)
TINY = dict(iterations=12, n_points=300, densify_from=4, densify_every=4)


class Foreign:
    """An array of another package: all that NumPy knows of it is `__array__`."""

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype)


class Capsule:
    """An array of another package that has `__dlpack__` alone."""

    def __init__(self, values):
        self.values = values

    def __dlpack__(self, **options):
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.values.__dlpack_device__()


@pytest.fixture(scope='module')
def geometry():
    return lm.Geometry.cone(**SCANNER, angles=circular(10))


@pytest.fixture(scope='module')
def data(geometry):
    return lm.simulate(lm.phantom('foot', size=20), geometry, views=8)


@pytest.fixture(scope='module')
def result(data):
    return lm.fit(data, 'fast', progress=False, **TINY)


def test_names():
    assert set(lm.__all__) <= set(dir(lm))
    for name in lm.__all__:
        assert getattr(lm, name).__doc__, name
    with pytest.raises(AttributeError, match='no attribute'):
        lm.nothing  # noqa: B018 - the look-up is the test


def test_import_is_light():
    """Importing the package loads Mitsuba and nothing heavy besides, and sets no variant."""
    code = (
        'import sys, mitsuba as mi; known = set(sys.modules); import lingo_mi; '
        "heavy = {'matplotlib', 'scipy', 'skimage', 'nibabel', 'trimesh', 'torch', 'jax', 'rich'}; "
        'assert not heavy & (set(sys.modules) - known), heavy & set(sys.modules); assert mi.variant() is None'
    )
    subprocess.run([sys.executable, '-c', code], check=True)


def test_the_variant_is_chosen_on_first_use():
    code = (
        "import lingo_mi as lm, mitsuba as mi; lm.simulate(lm.phantom('shepp_logan', size=8), views=1); "
        "assert mi.variant() in ('cuda_ad_mono', 'llvm_ad_mono'), mi.variant()"
    )
    subprocess.run([sys.executable, '-c', code], check=True, capture_output=True)


def test_simulate(data, geometry):
    assert data.train.projections.shape == (8, 24, 30) and len(data.test) == 2
    assert data.volume.shape == (20, 20, 20)
    held_out = geometry.subset([1, 3])
    with_test = lm.simulate(data.volume, geometry, held_out=held_out)
    assert len(with_test.train) == 10 and len(with_test.test) == 2
    # The same trilinear voxels, from whichever package they come.
    for volume in (Foreign(data.volume), Capsule(data.volume), data.volume.tolist()):
        np.testing.assert_array_equal(lm.simulate(volume, geometry).train.projections, with_test.train.projections)


def test_simulate_a_scene_and_a_phantom():
    found = lm.simulate('effects/psf', views=2, parameters=dict(pixels=12, pixel_size=24, voxels=8, voxel_size=16))
    assert len(found.train) == 2 and found.train.effects is not None
    plain = lm.simulate(lm.phantom('shepp_logan', size=8), views=3)
    assert len(plain.train) == len(plain.test) == 3 and plain.train.projections.shape[1:] == (512, 512)


@pytest.mark.parametrize(
    'call, message',
    [
        (lambda g: lm.simulate('nothing_like_it'), 'no such scene'),
        (lambda g: lm.simulate('x3d_foot', g), 'its own scanner'),
        (lambda g: lm.simulate(np.zeros((20, 20, 19)), g), 'nVoxel'),
        (lambda g: lm.simulate(np.full((20, 20, 20), np.nan), g), 'NaN'),
        (lambda g: lm.simulate(np.zeros((20, 20, 20))), 'geometry'),
        (lambda g: lm.simulate(lm.phantom('foot', size=20), g, views=11), '11 views'),
        (lambda g: lm.simulate(np.zeros((20, 20, 20)), g, parameters=dict(views=3)), 'parameters'),
        (lambda g: lm.phantom('hand'), 'no phantom'),
        (lambda g: lm.load('missing.pickle'), 'no such file'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), 'fastest'), 'no such recipe'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), 'fast', n_pints=3), 'n_pints'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), resume=True), 'checkpoint'),
        (lambda g: lm.fit(lm.Scan(g, np.zeros((10, 24, 30)))), 'zero everywhere'),
        (lambda g: lm.load_result('missing'), 'no such file'),
    ],
)
def test_bad_input_is_one_line(geometry, call, message):
    with pytest.raises(lm.InputError, match=message) as error:
        call(geometry)
    assert '\n' not in str(error.value)


def test_result(result, data):
    volume = result.volume()
    assert volume.shape == (20, 20, 20) and volume.dtype == np.float32
    views = result.render(data.test.geometry)
    assert views.shape == (2, 24, 30)
    numbers = result.metrics()
    assert all(value is None or isinstance(value, int | float) for value in numbers.values())
    assert numbers['psnr_3d'] > 10 and numbers['gaussians'] == len(result)
    assert 'Gaussians' in repr(result) and result.seconds > 0
    assert result._repr_html_().startswith('<img ')


def test_the_cloud_by_function(result, data):
    """`lm.project` and `lm.voxelize` of the result's Gaussians are what the result renders."""
    views = lm.project(*result.gaussians, data.test.geometry, extent=result.settings.model.extent)
    np.testing.assert_allclose(views, result.render(data.test.geometry), atol=2e-4 * views.max())
    grid = lm.voxelize(*result.gaussians, data.train.geometry, extent=result.settings.model.extent)
    np.testing.assert_allclose(grid, result.volume(), atol=2e-4 * grid.max())


def test_save_and_load(result, data, tmp_path):
    folder = result.save(tmp_path / 'foot')
    written = {path.name for path in folder.iterdir()}
    assert {'volume.nii.gz', 'gaussians.ply', 'result.xml', 'metrics.json', 'report.html', 'checkpoint.npz'} <= written
    with pytest.raises(lm.InputError, match='force'):
        result.save(folder)
    again = lm.load_result(folder)
    np.testing.assert_allclose(again.volume(), result.volume(), atol=1e-6)
    np.testing.assert_allclose(again.render(data.test.geometry), result.render(data.test.geometry), atol=1e-4)
    assert set(result.metrics()) <= set(again.metrics())
    assert again.metrics()['psnr_3d'] == pytest.approx(result.metrics()['psnr_3d'])
    assert again.metrics(data)['psnr_3d'] == pytest.approx(result.metrics()['psnr_3d'], abs=1e-4)
    assert len(lm.load_result(folder / 'checkpoint.npz')) == len(result)


def test_checkpoint_and_resume(data, tmp_path):
    path = tmp_path / 'fit.npz'
    short = TINY | dict(iterations=6)
    # Recipes whose rates fall over fixed steps can go on to more iterations: the same as in one go.
    lm.fit(data.train, 'r2', checkpoint=path, progress=False, **short)
    with pytest.raises(lm.InputError, match='resume=True'):
        lm.fit(data.train, 'r2', checkpoint=path, progress=False, **short)
    longer = lm.fit(data.train, 'r2', checkpoint=path, resume=True, progress=False, **TINY)
    direct = lm.fit(data.train, 'r2', progress=False, **TINY)
    np.testing.assert_allclose(longer.volume(), direct.volume(), atol=1e-6)


def test_records_are_printed_by_shape_not_by_values(data):
    plain = lm.reconstruct(data.train, lm.SIRT(niter=6), progress=False)
    assert 'projections=float32[' in repr(data.train) and 'volume=float32[20, 20, 20]' in repr(data)
    assert 'residuals=[1.0, ..., ' in repr(plain) and 'angles=float64[' in repr(plain)
    assert 'valid' not in repr(data.train)
    assert max(len(repr(x)) for x in (data.train, data, plain, lm.phantom('shepp_logan', size=8))) < 1000


def test_reconstruct(data, result):
    plain = lm.reconstruct(data.train, lm.SART(niter=2), progress=False)
    assert plain.volume.shape == (20, 20, 20) and len(plain.residuals) == 3 and plain.seconds > 0
    started = lm.reconstruct(data.train, lm.SART(niter=2), start=result, progress=False)
    from_array = lm.reconstruct(data.train, lm.SART(niter=2), start=Foreign(result.volume()), progress=False)
    np.testing.assert_allclose(started.volume, from_array.volume, atol=1e-6)
    assert started.residuals[0] < plain.residuals[0]
    refined = lm.reconstruct(data.train, lm.Refined(niter=2, completed_niter=0), start=result, progress=False)
    assert np.asarray(refined).shape == (20, 20, 20)
    assert lm.reconstruct(data.train, lm.FDK(), progress=False).residuals == []
    for algorithm, start, message in ((lm.Refined(), None, 'cloud'), (lm.FDK(), result, 'start')):
        with pytest.raises(lm.InputError, match=message):
            lm.reconstruct(data.train, algorithm, start=start, progress=False)


def test_examples_of_the_docstrings_name_what_exists():
    text = Path(lm.__file__).read_text(encoding='utf-8').split('"""')[1]
    used = {word.split('(')[0] for line in text.splitlines() for word in line.split() if word.startswith('lm.')}
    assert {word.removeprefix('lm.').split('.')[0].strip('(),') for word in used} <= set(lm.__all__)
