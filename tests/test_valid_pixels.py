"""Pixels that are left out, and scans that the panel cuts off: in the scan, its file, the initial cloud and the fit."""

import warnings
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
import yaml

from helpers.fits import SHORT, error_of, geometry, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan, write_scan
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.measure import quick_measure
from lingo_mi.fitting.methods.by_name import METHODS
from lingo_mi.fitting.start.masks import MaskStart
from lingo_mi.fitting.view_loss import MeasuredView
from lingo_mi.geometry.trajectories import circular
from lingo_mi.lingo.masks import masks, truncated
from lingo_mi.lingo.voxel_filter import valid_voxels, voxel_centres
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Dataset, Scan


@pytest.fixture(scope='module')
def scan():
    return tiny_scan(geometry(6))


def patches(scan, seed=0):
    """A mask that leaves out a patch of every view, a whole column, and one view's lower half."""
    rng = np.random.default_rng(seed)
    valid = np.ones(scan.projections.shape, bool)
    for mask in valid:
        row, column = rng.integers(6, 18, 2)
        mask[row : row + 7, column : column + 6] = False
    valid[:, :, 20] = False
    valid[2, 16:] = False
    return valid


def spoilt(scan, valid, value):
    return np.where(valid, scan.projections, value)


# ---- the scan ----------------------------------------------------------------------------------------------


def test_what_is_not_valid_is_forgotten(scan):
    valid = patches(scan)
    for value in (np.nan, 1e6, -3):
        masked = Scan(scan.geometry, spoilt(scan, valid, value), valid)
        np.testing.assert_array_equal(masked.projections, scan.projections * valid)
    np.testing.assert_array_equal(masked.subset([4, 1]).valid, valid[[4, 1]])
    assert Scan(scan.geometry, scan.projections, np.ones_like(valid)).valid is None
    binned = masked.binned(2)
    assert binned.valid.shape == binned.projections.shape
    for v, row, column in ((0, 3, 10), (2, 8, 3), (3, 0, 0)):
        assert binned.valid[v, row, column] == valid[v, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2].all()
    assert not binned.valid[:, :, 10].any() and binned.valid[3, 0, 0]


@pytest.mark.parametrize(
    'mask, match',
    [
        (np.ones((6, 32, 31), bool), 'shape of the projections'),
        (np.ones((6, 32, 32)), 'true or false'),
        (np.zeros((6, 32, 32), bool), 'no pixel'),
    ],
)
def test_bad_masks(scan, mask, match):
    with pytest.raises(InputError, match=match):
        Scan(scan.geometry, scan.projections, mask)


def test_files_keep_the_mask(tmp_path, scan):
    valid = patches(scan)
    masked = Scan(scan.geometry, scan.projections, valid)
    write_scan(tmp_path / 'a.npy', masked, 'npy')
    back = read_scan(tmp_path / 'a.npy').train
    np.testing.assert_array_equal(back.valid, valid)
    np.testing.assert_array_equal(back.projections, masked.projections)
    for kind in ('naf', 'r2', 'exr'):
        with pytest.raises(InputError, match='no mask of valid pixels'):
            write_scan(tmp_path / 'b', masked, kind)
    # One mask for all views; dead pixels of intensities have no logarithm, and masked NaN does no harm.
    values = yaml.safe_load((tmp_path / 'a.yml').read_text()) | {'input': 'intensity', 'I0': 1e4, 'valid': 'dead.npy'}
    counts = 1e4 * np.exp(-scan.projections / scan.projections.max())
    counts[:, 3, 4], counts[:, 5, 6] = 0, np.nan
    dead = np.ones((32, 32), bool)
    dead[3, 4] = dead[5, 6] = False
    np.save(tmp_path / 'a.npy', counts)
    np.save(tmp_path / 'dead.npy', dead)
    (tmp_path / 'a.yml').write_text(yaml.safe_dump(values))
    back = read_scan(tmp_path / 'a.npy').train
    np.testing.assert_array_equal(back.valid, np.broadcast_to(dead, valid.shape))
    np.testing.assert_allclose(back.projections, dead * scan.projections / scan.projections.max(), atol=1e-6)
    for bad, match in ((dead.astype(float), 'must be bool'), (dead[:5], 'of the shape')):
        np.save(tmp_path / 'dead.npy', bad)
        with pytest.raises(InputError, match=match):
            read_scan(tmp_path / 'a.npy')
    (tmp_path / 'a.yml').write_text(yaml.safe_dump({k: v for k, v in values.items() if k != 'valid'}))
    with pytest.raises(InputError, match='NaN'):
        read_scan(tmp_path / 'a.npy')


def test_filtered_backprojection_needs_every_pixel(scan):
    with pytest.raises(InputError, match='needs every pixel'):
        run_algorithm(Scan(scan.geometry, scan.projections, patches(scan)), FDK(fill=False))


# ---- the initial cloud -------------------------------------------------------------------------------------


def brute_force(frames, masked, points, misses, outside):
    """Low valid set by the definition, one point and view at a time."""
    keep = []
    for point in points:
        missed = seen = 0
        for view in range(len(frames)):
            x, y = (q[0] for q in frames.project(point[None], view))
            inside = 0 <= x < masked.low.shape[2] and 0 <= y < masked.low.shape[1]
            if not inside:
                missed += outside == 'invalid'
            elif masked.valid[view, int(y), int(x)]:
                seen += 1
                missed += not masked.low[view, int(y), int(x)]
        keep.append(missed <= misses and seen > 0)
    return np.flatnonzero(keep)


@pytest.mark.parametrize(
    'misses, outside',
    [
        (0, 'invalid'),
        (1, 'ignore'),
        *(pytest.param(*other, marks=pytest.mark.thorough) for other in ((0, 'ignore'), (1, 'invalid'))),
    ],
)
def test_views_say_nothing_behind_invalid_pixels(scan, outside, misses):
    g, valid = scan.geometry, patches(scan)
    masked = masks(spoilt(scan, valid, 1e9) * g.grid.scale, 0.1, valid)
    assert not (masked.low | masked.high)[~valid].any() and masked.high[valid].any() and not masked.high[valid].all()
    expected = masks(np.where(valid, scan.projections, np.nan)[0][valid[0]][None, None] * g.grid.scale, 0.1)
    assert masked.t_high[0] == expected.t_high[0]  # the threshold of the valid pixels alone
    frames, grid = g.normalised_rays(), (8, 8, 8)
    low, high = valid_voxels(frames, masked, grid, g.grid.half, misses, outside)
    np.testing.assert_array_equal(low, brute_force(frames, masked, voxel_centres(grid, g.grid.half), misses, outside))
    assert len(low) > len(valid_voxels(frames, masks(scan.projections * valid), grid, g.grid.half, misses, outside)[0])
    # Blocks of cells are tested at once on large grids; they must not lose a cell behind an invalid pixel.
    large = (40, 40, 40)
    whole = valid_voxels(frames, masked, large, g.grid.half, misses, outside)[0]
    sample = np.random.default_rng(0).choice(40**3, 150, replace=False)
    expected = sample[brute_force(frames, masked, voxel_centres(large, g.grid.half, sample), misses, outside)]
    np.testing.assert_array_equal(np.sort(expected), np.intersect1d(whole, sample))


def test_densities_come_from_valid_pixels(scan):
    """The cloud is the same, whatever stands in the other pixels."""
    g, valid, clouds = scan.geometry, patches(scan), []
    for value in (0, 1e6):

        def render(points, density, spacing, views, value=value):
            return spoilt(scan, valid, value)[views] * g.grid.scale

        clouds.append(
            MaskStart(n_points=300).from_views(
                # A Scan would forget what stands there.
                SimpleNamespace(geometry=g, normalised=spoilt(scan, valid, value) * g.grid.scale, valid=valid),
                np.random.default_rng(0),
                render,
            )
        )
    np.testing.assert_array_equal(clouds[0].points, clouds[1].points)
    np.testing.assert_array_equal(clouds[0].density, clouds[1].density)
    assert (clouds[0].density > 0).all()


# ---- truncation --------------------------------------------------------------------------------------------


def cropped(columns=14):
    """The object is wider than the panel: only its middle columns are seen."""
    g = geometry(6, nDetector=(32, columns))
    return tiny_scan(g), tiny_scan(geometry(6, nDetector=(48, 48)))


def test_truncated_views_are_found():
    narrow, wide = cropped()
    assert truncated(masks(narrow.projections)).all()
    assert not truncated(masks(wide.projections)).any()
    one = wide.projections.copy()
    one[3, 5:9, 0] = one.max()
    assert truncated(masks(one)).tolist() == [False, False, False, True, False, False]
    fan = np.zeros((2, 1, 32))
    fan[:, :, 10:20] = 1
    assert not truncated(masks(fan)).any()


def test_truncated_scans_keep_what_the_panel_misses():
    narrow, wide = cropped()
    g = narrow.geometry

    def cloud(outside):
        return METHODS['lingo'].changed(outside=outside, n_points=400).starting_cloud(narrow)

    with warnings.catch_warnings():
        warnings.simplefilter('error')
        automatic = cloud('auto')
        literal = cloud('ignore')
        whole = METHODS['lingo'].changed(outside='auto', n_points=400).starting_cloud(wide)
    with pytest.warns(UserWarning, match='edge of the panel in 6 of 6 views'):
        strict = cloud('invalid')
    assert automatic.info['outside'] == 'ignore' and whole.info['outside'] == 'invalid'
    np.testing.assert_array_equal(automatic.points, literal.points)
    # Columns of the points in the first view, from the middle of the 14. Points are drawn up to half a cell from those seen.
    beyond = [np.mean(np.abs(g.normalised_rays().project(c.points, 0)[0] - 7) > 7.5) for c in (strict, automatic)]
    assert beyond[0] == 0 and beyond[1] > 0.02


# ---- the fit -----------------------------------------------------------------------------------------------


def kernels(scan, method):
    """Hashes of the compiled kernels of a fit, in the order of their launches, traced in every step."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        dr.kernel_history_clear()
        run(scan, method, seed=3)
        return [k['hash'] for k in dr.kernel_history([dr.KernelType.JIT])]


def test_without_a_mask_no_kernel_knows_of_masks(scan, monkeypatch):
    method = SHORT.changed(iterations=6, densify_from=100)
    masked = Scan(scan.geometry, scan.projections, patches(scan))
    plain, with_mask = kernels(scan, method), kernels(masked, method)
    with monkeypatch.context() as patch:
        patch.setattr(MeasuredView, 'masked', lambda self, image: image)
        bare = kernels(scan, method)
    assert plain == bare and len(plain) > 6
    assert set(with_mask) - set(plain)
    assert len(set(with_mask)) <= len(set(plain))  # one form for all views, whatever their masks


def test_held_out_pixels_that_are_not_valid_do_not_count(scan):
    dataset = Dataset(scan, Scan(scan.geometry, scan.projections, patches(scan)))

    def measured(value):
        views = spoilt(scan, patches(scan), value) * np.float32(1.01)
        return quick_measure(SimpleNamespace(data=dataset, views=views))

    assert measured(0) == measured(1e6) and np.isfinite(measured(0)['psnr_2d'])


def test_fit_of_a_spoilt_scan(scan):
    """With the mask, what is not valid leaves no trace in the fit; without it, it ruins the fit."""
    valid, method = patches(scan), SHORT.changed(iterations=150, densify_from=1000)
    good = run(scan, method, seed=3)
    masked = run(Scan(scan.geometry, spoilt(scan, valid, 5 * scan.projections.max()), valid), method, seed=3)
    ruined = run(Scan(scan.geometry, spoilt(scan, valid, 0)), method, seed=3)
    errors = [error_of(fitted, scan) for fitted in (good, masked, ruined)]
    assert errors[1] < 2 * errors[0] and errors[1] < errors[2] / 2


def test_initial_cloud_of_a_masked_scan(scan):
    masked = Scan(scan.geometry, scan.projections, patches(scan))
    cloud = METHODS['fast'].changed(n_points=300).starting_cloud(masked)
    assert len(cloud) == 300 and (cloud.density > 0).all()
    with pytest.warns(UserWarning, match='were filled'):
        assert len(METHODS['r2'].changed(n_points=300).starting_cloud(masked)) == 300


def test_views_without_one_valid_pixel():
    scan = tiny_scan(geometry(4, angles=circular(4, 180)))
    valid = np.ones(scan.projections.shape, bool)
    valid[1] = False
    blind = Scan(scan.geometry, scan.projections, valid)
    fitted = run(blind, SHORT.changed(start='edges', n_points=200, iterations=8))
    assert all(np.isfinite(v).all() for v in fitted.state.values.values())
