"""`import lingo_mi as lm`: what it names, what it loads, and a fit from nothing to files and back."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lingo_mi as lm
from helpers.same import assert_same
from lingo_mi.files.volumes import read_volume
from lingo_mi.geometry import circular
from lingo_mi.metrics.quality import psnr_3d

SCANNER = dict(DSO=100, DSD=150, nDetector=(24, 30), dDetector=(2, 2), nVoxel=(20,) * 3, dVoxel=(1.2,) * 3)
VOLUME = np.linspace(0, 1, 8000).reshape(20, 20, 20)  # densities per mm
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
    assert lm.circular is circular
    for name in lm.__all__:
        assert getattr(lm, name).__doc__, name
    with pytest.raises(AttributeError, match='no attribute'):
        lm.nothing  # noqa: B018 - the look-up is the test


def test_editors_read_the_same_names():
    (listing,) = (node for node in ast.parse(Path(lm.__file__).read_text('utf-8')).body if isinstance(node, ast.If))
    assert {name.name: line.module for line in listing.body for name in line.names} == lm._PUBLIC


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
    actual = lm.simulate('effects/psf', views=2, parameters=dict(pixels=12, pixel_size=24, voxels=8, voxel_size=16))
    assert len(actual.train) == 2 and actual.train.effects is not None
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
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), 'fastest'), "there is no method 'fastest'"),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), 'fast', n_pints=3), 'n_pints'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), resume=True), 'give folder=FOLDER'),
        (lambda g: lm.fit(lm.Scan(g, np.zeros((10, 24, 30)))), 'zero everywhere'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), 'fast', n_pints=3), 'did you mean n_points'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), None), 'method must be a str or a Method, not NoneType'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), seed=1.5), 'seed must be a whole number'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), iterations=2.5), 'iterations must be a whole number'),
        (lambda g: lm.fit(lm.Scan(g, np.ones((10, 24, 30))), folder=3), 'folder must be a path, not int'),
        (lambda g: lm.load_fit('missing'), 'missing: there is no fit here'),
        (lambda g: lm.load_fit(g), 'path must be a path'),
        (lambda g: lm.load('scan.npy', g), 'geometry must be the path of a geometry file, not CircularGeometry'),
        (lambda g: lm.load('scan.npy', views=0), 'views must be a whole number from 1 on, not 0'),
        (lambda g: lm.load(None), 'path must be a path'),
        (lambda g: lm.simulate(VOLUME, {}), 'geometry must be a Geometry, not dict'),
        (lambda g: lm.simulate(VOLUME, g, views=11), '11 views were asked for, but the scan has 10'),
        (lambda g: lm.simulate(VOLUME, g, held_out=[1, 2]), 'held_out must be a Geometry, not list'),
        (lambda g: lm.simulate(VOLUME, g, views=0), 'views must be a whole number from 1 on, not 0'),
        (lambda g: lm.simulate(VOLUME, g, views=2.5), 'views must be a whole number'),
        (lambda g: lm.simulate(VOLUME, g, seed=-1), 'seed must be a whole number from 0 on, not -1'),
        (lambda g: lm.simulate('x3d_foot', parameters=['views']), 'parameters must be a dict'),
        (lambda g: lm.simulate(1500 * VOLUME - 1000, g), 'Hounsfield units by'),
        (lambda g: lm.simulate(3500 * VOLUME - 1000, g), 'Hounsfield units by'),
        (lambda g: lm.simulate(VOLUME - 0.6, g), 'Hounsfield units by'),
        (
            lambda g: lm.reconstruct(lm.Scan(g, np.ones((10, 24, 30))), lm.SART(), start='out/x'),
            "lm.load_fit\\('out/x'",
        ),
        (
            lambda g: lm.reconstruct(lm.Scan(g, np.ones((10, 24, 30))), lm.SART(), start={}),
            'start volume cannot be read',
        ),
        (lambda g: lm.reconstruct(np.ones(3), lm.SART()), 'scan must be a Scan or a Dataset, not ndarray'),
        (lambda g: lm.Scan(np.ones((10, 24, 30)), g), 'geometry must be a Geometry, not ndarray; write Scan'),
        (lambda g: lm.Dataset(np.ones((10, 24, 30))), 'train must be a Scan, not ndarray'),
        (lambda g: lm.Dataset(lm.Scan(g, np.ones((10, 24, 30))), g), 'test must be a Scan'),
        (lambda g: lm.Scan(g, np.ones((10, 24, 30))).subset([99]), 'from 0 to 9, not by'),
        (lambda g: g.subset([-11]), 'from 0 to 9, not by'),
        (lambda g: lm.Scan(g, np.ones((10, 24, 30))).binned(2.5), 'binning of pixels must be a whole number'),
        (lambda g: g.grid.slabs(2.5), 'thickness of a slab, in slices, must be a whole number'),
        (lambda g: lm.project(*np.ones((4, 3)), {}), 'geometry must be a Geometry, not dict'),
        (lambda g: lm.project(*np.ones((4, 3)), g, extent='3'), 'extent is in standard deviations, from 1 to 20'),
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
    assert result._repr_html_().count('<input type="range"') == 5  # three planes, rendered and measured views


@pytest.mark.parametrize(
    'call, message',
    [
        (lambda r: r.render('x'), 'geometry must be a Geometry, not str'),
        (lambda r: r.volume((64, 64, 64)), 'grid must be a Grid, not tuple'),
        (lambda r: r.metrics(VOLUME), 'data must be a Dataset, not ndarray'),
        (lambda r: r.save(3), 'folder must be a path, not int'),
    ],
)
def test_a_result_refuses_other_types(result, call, message):
    with pytest.raises(lm.InputError, match=message):
        call(result)


def test_undershoots_are_no_hounsfield_units(geometry):
    assert lm.simulate(VOLUME - 0.3, geometry, progress=False).train.projections.min() < 0


def test_where_nothing_can_be_written(result, data, tmp_path, monkeypatch):
    """A file in the place of a folder gives one line, before a fit starts."""
    (tmp_path / 'file').write_text('')
    monkeypatch.setattr('lingo_mi.api.fitting.run', None)
    for write in lambda folder: lm.fit(data, folder=folder, progress=False, **TINY), result.save:
        for folder in tmp_path / 'file', tmp_path / 'file' / 'folder':
            with pytest.raises(lm.InputError, match='cannot write there|is a file|cannot be written') as caught:
                write(folder)
            assert '\n' not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ['file']


@pytest.mark.parametrize('name', ['checkpoint.npz', 'metrics.json', 'volume.nii.gz', 'notes.txt'])
def test_a_fit_overwrites_nothing(data, tmp_path, monkeypatch, name):
    """Without force=True a fit overwrites nothing; with it, other programs' files and the targets of links stay."""
    monkeypatch.setattr('lingo_mi.api.fitting.run', None)
    (tmp_path / 'out').mkdir()
    (tmp_path / 'out' / name).write_text('mine')
    (tmp_path / 'linked').mkdir()
    (tmp_path / 'linked' / name).symlink_to(tmp_path / 'out' / name)
    for folder in tmp_path / 'out', tmp_path / 'linked':
        for options in {}, dict(force=True), dict(resume=True):
            if name == 'notes.txt' and options:
                continue
            with pytest.raises(lm.InputError, match='give |move it away|run without resume=True') as caught:
                lm.fit(data, folder=folder, progress=False, **options, **TINY)
            assert '\n' not in str(caught.value)
    assert (tmp_path / 'out' / name).read_text() == 'mine' and len([*tmp_path.rglob('*')]) == 4


def test_a_reconstruction_is_measured_and_saved(data, tmp_path):
    reconstruction = lm.reconstruct(data, lm.SART(niter=2), progress=False)
    numbers = reconstruction.metrics(data.volume)
    assert list(numbers) == ['psnr_3d', 'ssim_3d', 'psnr_3d_r2', 'ssim_3d_r2']
    assert numbers['psnr_3d'] == psnr_3d(reconstruction.volume, data.volume) > 10
    assert reconstruction.metrics(reconstruction)['psnr_3d'] is None  # infinite
    path = reconstruction.save(tmp_path / 'new' / 'foot.nii.gz')
    stored = read_volume(path)
    np.testing.assert_array_equal(stored.data, reconstruction.volume)
    np.testing.assert_allclose(stored.spacing, data.train.geometry.grid.spacing)
    np.testing.assert_allclose(stored.affine[:3, 3], data.train.geometry.grid.first_voxel)
    with pytest.raises(lm.InputError, match='force=True'):
        reconstruction.save(path)
    assert reconstruction.save(str(path), force=True) == path
    for bad in tmp_path / 'foot.npy', path / 'x.nii', 3:
        with pytest.raises(lm.InputError):
            reconstruction.save(bad)
    with pytest.raises(lm.InputError, match='volumes have the shapes'):
        reconstruction.metrics(data.volume[1:])


def test_the_cloud_by_function(result, data):
    """`lm.project` and `lm.voxelize` of the result's Gaussians are what the result renders."""
    cloud, geometry = result.gaussians, data.test.geometry
    views = lm.project(cloud, geometry)
    np.testing.assert_allclose(views, result.render(geometry), atol=2e-4 * views.max())
    np.testing.assert_array_equal(lm.project(*cloud, geometry, extent=result.method.extent), views)
    np.testing.assert_array_equal(lm.project(cloud, geometry=geometry), views)
    assert not np.array_equal(lm.project(*cloud, geometry), views)  # arrays alone are cut off farther out
    grid = lm.voxelize(cloud, data.train.geometry)
    np.testing.assert_allclose(grid, result.volume(), atol=2e-4 * grid.max())
    with pytest.raises(lm.InputError, match='Gaussians hold all four arrays'):
        lm.project(cloud, cloud.scales, cloud.quaternions, cloud.density, geometry)
    with pytest.raises(lm.InputError, match='geometry must be a Geometry, not NoneType'):
        lm.project(cloud)


def test_save_and_load(result, data, tmp_path, request):
    folder = result.save(tmp_path / 'foot')
    written = {path.name for path in folder.iterdir()}
    assert {'volume.nii.gz', 'gaussians.ply', 'result.xml', 'metrics.json', 'report.html', 'checkpoint.npz'} <= written
    with pytest.raises(lm.InputError, match='force'):
        result.save(folder)
    again = lm.load_fit(folder)
    np.testing.assert_allclose(again.volume(), result.volume(), atol=1e-6)
    np.testing.assert_allclose(again.render(data.test.geometry), result.render(data.test.geometry), atol=1e-4)
    assert set(result.metrics()) <= set(again.metrics())
    assert again.metrics()['psnr_3d'] == pytest.approx(result.metrics()['psnr_3d'])
    assert again.metrics(data)['psnr_3d'] == pytest.approx(result.metrics()['psnr_3d'], abs=1e-4)
    assert len(lm.load_fit(folder / 'checkpoint.npz')) == len(result)
    request.getfixturevalue('no_report')
    for copy in tmp_path / 'copy', folder:  # the truth is gone, its numbers are not
        again.save(copy, force=True)
        copied = lm.load_fit(copy).metrics()
        for name in 'psnr_2d', 'ssim_2d', 'psnr_3d', 'ssim_3d':
            assert copied[name] is not None and copied[name] == again.metrics()[name], name
    for damaged in '[]', '{':
        (folder / 'metrics.json').write_text(damaged)
        with pytest.raises(lm.InputError, match='metrics.json: is damaged'):
            lm.load_fit(folder)


@pytest.mark.thorough
def test_a_folder_and_resume(data, tmp_path, sums_in_order):
    folder = tmp_path / 'fit'
    short = TINY | dict(iterations=6)
    # Methods whose rates fall over fixed steps can go on to more iterations: the same as in one go.
    lm.fit(data, 'r2', folder=folder, progress=False, **short)
    with pytest.raises(lm.InputError, match='resume=True'):
        lm.fit(data, 'r2', folder=folder, progress=False, **short)
    longer = lm.fit(data, 'r2', folder=folder, resume=True, progress=False, **TINY)
    direct = lm.fit(data, 'r2', progress=False, **TINY)
    np.testing.assert_allclose(longer.volume(), direct.volume(), atol=1e-6)
    loaded = lm.load_fit(folder)
    assert loaded.metrics()['psnr_3d'] == longer.metrics()['psnr_3d']
    np.testing.assert_array_equal(loaded.volume(), longer.volume())
    with pytest.raises(lm.InputError, match='other values of seed'):
        lm.fit(data, 'r2', seed=1, folder=folder, resume=True, progress=False, **TINY)
    again = lm.fit(data, 'r2', seed=1, folder=folder, force=True, progress=False, note=dict(command='x'), **short)
    assert lm.load_fit(folder).record['command'] == 'x' and lm.load_fit(folder).steps == again.steps == 6


def test_a_fit_that_is_stopped_goes_on(result, data, tmp_path, sums_in_order, no_report):
    def stop(iteration, **_):
        if iteration == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lm.fit(data, 'fast', folder=tmp_path, progress=stop, **TINY)
    assert {path.name for path in tmp_path.iterdir()} == {'checkpoint.npz', '.lingo_mi.json'}
    assert lm.load_fit(tmp_path / 'checkpoint.npz').steps == 5
    with pytest.raises(lm.InputError, match='a result was not completed here'):
        lm.load_fit(tmp_path)
    with pytest.raises(lm.InputError, match='holds a fit that was not completed; give resume=True'):
        lm.fit(data, 'fast', folder=tmp_path, progress=False, **TINY)
    resumed = lm.fit(data, 'fast', folder=tmp_path, resume=True, progress=False, **TINY)
    np.testing.assert_allclose(resumed.volume(), result.volume(), atol=1e-6)


def test_records_are_printed_by_shape_not_by_values(data):
    plain = lm.reconstruct(data.train, lm.SIRT(niter=6), progress=False)
    assert 'projections=float32[' in repr(data.train) and 'volume=float32[20, 20, 20]' in repr(data)
    assert 'residuals=[1.0, ..., ' in repr(plain) and 'angles=float64[' in repr(data.train.geometry)
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


def test_reconstruct_into_a_file(data, result, tmp_path):
    """The volume is the same whole or in slabs, and no working file is left beside it."""
    for name, algorithm, options in (
        ('sart', lm.SART(niter=2), {}),
        ('fdk', lm.FDK(), dict(start=result, views=12)),
        ('best', lm.Best(niter=1, finer=1), {}),
    ):
        whole = lm.reconstruct(data, algorithm, out=tmp_path / f'{name}.nii', progress=False, **options)
        np.testing.assert_array_equal(read_volume(tmp_path / f'{name}.nii').data, whole.volume)
        if name != 'best':
            path = lm.reconstruct(data, algorithm, out=str(tmp_path / 's.nii'), slab=7, progress=False, **options)
            np.testing.assert_allclose(read_volume(path).data, whole.volume, atol=1e-5 * whole.volume.max())
            path.unlink()
    written = {'sart.nii', 'fdk.nii', 'best.nii', 'best-plan.json', 'best-error.nii'}
    assert {path.name for path in tmp_path.iterdir()} == written


@pytest.mark.parametrize(
    'algorithm, options, message',
    [
        (lm.SART(), dict(slab=4), 'give out=FILE'),
        (lm.SART(), dict(slab=0, out='v.nii'), 'slab must be a whole number from 1 on'),
        (lm.CGLS(), dict(slab=4, out='v.nii'), 'cgls needs the whole volume'),
        (lm.SART(), dict(slab=4, out='v.nii', start=VOLUME), 'leave out start, or slab'),
        (lm.SART(), dict(views=20), 'give the fit as start'),
        (lm.SART(), dict(views=20, start=VOLUME), 'give the fit as start'),
        (lm.Best(), dict(start=VOLUME), 'leave out start'),
        (lm.SART(), dict(out='v.npy'), 'ends in .nii'),
        (lm.SART(), dict(out='there.nii'), 'force=True'),
        (lm.SART(), dict(out='folder.nii', force=True), 'is a folder'),
        (lm.Best(), dict(out='best.nii'), 'best-plan.json: exists already'),
        (lm.SART(), dict(out='/proc/v.nii'), 'cannot write'),
        ('sart', {}, 'an object such as lm.SART'),
    ],
)
def test_reconstruct_refuses_before_it_works(data, tmp_path, monkeypatch, algorithm, options, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr('lingo_mi.api.volumes.run_algorithm', None)
    monkeypatch.setattr('lingo_mi.api.volumes.run_in_slabs', None)
    (tmp_path / 'folder.nii').mkdir()
    for name in 'there.nii', 'best-plan.json':
        (tmp_path / name).write_text('mine')
    with pytest.raises(lm.InputError, match=message):
        lm.reconstruct(data, algorithm, progress=False, **options)
    assert len([*tmp_path.iterdir()]) == 3 and (tmp_path / 'there.nii').read_text() == 'mine'


def test_examples_of_the_docstrings_name_what_exists():
    text = Path(lm.__file__).read_text(encoding='utf-8').split('"""')[1]
    used = {word.split('(')[0] for line in text.splitlines() for word in line.split() if word.startswith('lm.')}
    assert {word.removeprefix('lm.').split('.')[0].strip('(),') for word in used} <= set(lm.__all__)


@pytest.mark.thorough
def test_a_result_with_modelled_effects_is_loaded(tmp_path):
    """A checkpoint does not keep the effects, but the result.xml beside it does."""
    sizes = dict(pixels=24, pixel_size=12, voxels=16, voxel_size=2.4)
    data = lm.simulate('effects/focal_spot', views=6, parameters=sizes, progress=False)
    result = lm.fit(data, 'fast', iterations=5, n_points=100, progress=False)
    result.save(tmp_path / 'out')
    again = lm.load_fit(tmp_path / 'out')
    assert_same(again.volume(), result.volume())
    np.testing.assert_allclose(again.render(data.train.geometry), result.render(data.train.geometry), atol=1e-5)
    with pytest.raises(lm.InputError, match='load the folder of its result'):
        lm.load_fit(tmp_path / 'out' / 'checkpoint.npz')


@pytest.mark.parametrize('change', [dict(dVoxel=16.0), dict(offOrigin=(30.0, 0.0, 0.0))])
def test_a_phantom_on_another_grid_is_its_voxels(change):
    """Its voxels are scanned even if it has exact projections, which hold for its own grid alone."""
    sizes = dict(DSO=1000, DSD=1500, nDetector=(40, 48), dDetector=12, nVoxel=32, angles=circular(3))
    phantom = lm.phantom('shepp_logan', size=32)
    scan_geometry = lm.Geometry.cone(**sizes, dVoxel=8.0)
    exact = lm.simulate(phantom, scan_geometry, progress=False).train.projections
    voxels = lm.simulate(phantom.data, scan_geometry, progress=False).train.projections
    assert 0.01 < np.std(exact - voxels) / exact.max() < 0.1
    other = lm.Geometry.cone(**sizes | dict(dVoxel=8.0) | change)
    projections = lm.simulate(phantom, other, progress=False).train.projections
    assert_same(projections, lm.simulate(phantom.data, other, progress=False).train.projections)
