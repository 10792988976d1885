"""Masks and the voxel filter against loop-written transcriptions of the paper's section III-A."""

import numpy as np
import pytest

from helpers.circles import circle
from helpers.short import short
from lingo_mi.common.errors import InputError
from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.trajectories import circular
from lingo_mi.lingo import voxel_filter
from lingo_mi.lingo.masks import Masks, masks, truncated
from lingo_mi.lingo.otsu import otsu
from lingo_mi.lingo.scaling import occupancy, scale_factor, scaled_grid
from lingo_mi.lingo.voxel_filter import valid_voxels, voxel_centres


def scan(mode='cone', n=5, **changes):
    settings = dict(
        DSO=5.0,
        DSD=7.0,
        nDetector=(24, 28),
        dDetector=(0.15, 0.14),
        nVoxel=(12, 10, 9),
        dVoxel=(0.2, 0.2, 0.2),
        angles=circular(n, start=13),
        mode=mode,
        offOrigin=(0.1, 0.0, -0.05),
        offDetector=(0.043, 0.1),
    )
    return circle(**{**settings, **changes})


def random_masks(n, shape, rng):
    """Blobs: waves cut at two heights, so that the intersection over the views is neither empty nor full."""
    y, x = np.indices(shape)
    phase = rng.uniform(0, 6, (n, 2, 1, 1))
    field = np.cos(x / shape[1] * 9 + phase[:, 0]) + np.cos(y / shape[0] * 7 + phase[:, 1])
    return Masks(field > -0.9, field > -0.2, np.full(n, -0.9), np.full(n, -0.2))


def literal_filter(frames, image_masks, grid, half, misses=0, ignore=False):
    """P^I = floor(clip(M P)), M^P = M^I[P^I], intersection over the views: a point and a view at a time."""
    valid = []
    for i in range(grid[0]):
        for j in range(grid[1]):
            for k in range(grid[2]):
                point = [(index + 0.5) / n * 2 * h - h for index, n, h in zip((i, j, k), grid, half)]
                missed = seen = 0
                for o in range(len(frames)):
                    (x,), (y,) = frames.project([point], o)
                    inside = 0 <= x < image_masks.shape[2] and 0 <= y < image_masks.shape[1]
                    seen += inside
                    if inside:
                        missed += not image_masks[o, int(np.floor(y)), int(np.floor(x))]
                    else:
                        missed += not ignore
                if missed <= misses and seen:
                    valid.append((i * grid[1] + j) * grid[2] + k)
    return valid


def literal_otsu(image, bins=256):
    """The bin centre t that maximises w0 w1 (mu0 - mu1)^2."""
    counts, edges = np.histogram(image, bins)
    centres = (edges[1:] + edges[:-1]) / 2
    best, threshold = -1, None
    for t in range(bins - 1):
        w0, w1 = counts[: t + 1].sum(), counts[t + 1 :].sum()
        if w0 and w1:
            mu0 = (counts[: t + 1] * centres[: t + 1]).sum() / w0
            mu1 = (counts[t + 1 :] * centres[t + 1 :]).sum() / w1
            if w0 * w1 * (mu0 - mu1) ** 2 > best:
                best, threshold = w0 * w1 * (mu0 - mu1) ** 2, centres[t]
    return threshold


def test_otsu():
    rng = np.random.default_rng(0)
    image = np.where(rng.random((40, 50)) < 0.3, rng.normal(3, 0.4, (40, 50)), rng.normal(0.5, 0.3, (40, 50)))
    image = image.astype(np.float32)
    assert abs(otsu(image) - literal_otsu(image)) < 1e-5
    assert 1 < otsu(image) < 2.5


@pytest.mark.parametrize('value', [0.0, 0.7, -1.0])
def test_otsu_of_a_flat_image_is_its_value(value):
    image = np.full((5, 6), value, np.float32)
    assert otsu(image) == np.float32(value)
    assert not masks(image[None]).high.any()


def test_masks():
    images = np.random.default_rng(0).random((3, 8, 9)).astype(np.float32)
    images *= np.array([1, 2, 0])[:, None, None]
    masked = masks(images, 0.1)
    for o, image in enumerate(images):
        t_high = otsu(image)
        assert masked.t_high[o] == t_high and masked.t_low[o] == t_high * 0.1
        np.testing.assert_array_equal(masked.high[o], image > t_high)
        np.testing.assert_array_equal(masked.low[o], image > t_high * 0.1)
    assert not masked.low[2].any()


def test_otsu_of_an_image_that_is_constant_but_for_rounding():
    image = np.ones((5, 6), np.float32)
    image[2, 3] = np.nextafter(np.float32(1), np.float32(2))
    assert 1 <= otsu(image) <= image.max()


@pytest.mark.parametrize('axis', [0, 1])
def test_views_that_the_panel_cuts_within_its_valid_pixels(axis):
    """A frame without valid pixels hides nothing; a line without any does not count."""
    low, valid = np.zeros((2, 20, 30), bool), np.ones((2, 20, 30), bool)
    valid[:, [0, -1]], valid[:, :, [0, 1, -1]] = False, False
    inside = np.moveaxis(low, 1 + axis, 1)
    inside[1, 1 if axis == 0 else 2, 5:12] = True
    nothing = np.zeros(2)
    assert truncated(Masks(low, low, nothing, nothing, valid)).tolist() == [False, True]


@pytest.mark.parametrize(
    'shape, axis', [((40, 60), 0), ((40, 60), 1), ((2, 60), 0), ((40, 2), 1), ((1, 60), 0), ((40, 1), 1)]
)
@pytest.mark.parametrize('end', [0, -1])
def test_views_that_the_panel_cuts(shape, axis, end):
    """They have the object in more than 1 in 20 pixels of a side, away from its corners. An axis of one pixel has no sides."""
    length, across = shape[1 - axis], shape[axis]
    low = np.zeros((length // 20 + 2, *shape), bool)
    for count, image in enumerate(low):
        np.moveaxis(image, axis, 0)[end, 5 : 5 + count] = True
    expected = [across > 1 and count > length / 20 for count in range(len(low))]
    nothing = np.zeros(len(low))
    assert truncated(Masks(low, low, nothing, nothing)).tolist() == expected


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_camera_matrices(mode):
    frames = scan(mode).normalised_rays()
    points = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    for view, matrix in enumerate(camera_matrices(frames)):
        x, y, w = matrix @ np.c_[points, np.ones(30)].T
        np.testing.assert_allclose((x / w, y / w), frames.project(points, view), rtol=1e-10)
        assert (w > 0).all()
    if mode == 'cone':
        assert (camera_matrices(frames) @ np.r_[2 * frames.source[0], 1])[0, 2] < 0  # behind the source


def test_voxel_centres():
    centres = voxel_centres((2, 3, 4), (1, 0.6, 0.4)).reshape(2, 3, 4, 3)
    np.testing.assert_allclose(centres[0, 0, 0], (-0.5, -0.4, -0.3))
    np.testing.assert_allclose(centres[1, 2, 3], (0.5, 0.4, 0.3))
    np.testing.assert_allclose(voxel_centres((2, 3, 4), (1, 0.6, 0.4), [13]), centres[1, 0, 1][None])


FILTERS = {
    f'{mode}, {misses} misses, {outside}': (mode, misses, outside)
    for mode in ('cone', 'parallel')
    for misses, outside in ((0, 'invalid'), (2, 'invalid'), (0, 'ignore'), (1, 'ignore'))
}
SHORT = 'cone, 0 misses, invalid', 'cone, 1 misses, ignore', 'parallel, 2 misses, invalid'


@pytest.mark.parametrize('mode, misses, outside', short(FILTERS, SHORT))
def test_valid_voxels(monkeypatch, mode, misses, outside):
    geometry = scan(mode, dDetector=(0.1037, 0.0911), nVoxel=(9, 7, 6))  # panel too small
    frames, grid = geometry.normalised_rays(), geometry.grid.shape
    masked = random_masks(len(frames), geometry.nDetector, np.random.default_rng(4))
    expected = [
        literal_filter(frames, images, grid, geometry.grid.half, misses, outside == 'ignore')
        for images in (masked.low, masked.high)
    ]
    assert 0 < len(expected[0]) < np.prod(grid) and len(expected[1]) < len(expected[0])
    for blocks in (False, True):
        if blocks:  # the coarse rejection must change nothing
            monkeypatch.setattr(voxel_filter, 'CHUNK', 100)
            monkeypatch.setattr(voxel_filter, 'BLOCK', 3)
        cells = valid_voxels(frames, masked, grid, geometry.grid.half, misses, outside)
        assert [c.tolist() for c in cells] == expected


def test_points_outside_the_image_are_removed_not_clamped():
    geometry = scan(nDetector=(24, 4), offDetector=(0.0, 0.0), offOrigin=(0.0, 0.0, 0.0))
    frames, ones = geometry.normalised_rays(), np.ones((5, 24, 4), bool)
    full = Masks(ones, ones, np.zeros(5), np.zeros(5))
    strict, _ = valid_voxels(frames, full, geometry.grid.shape, geometry.grid.half)
    tolerant, _ = valid_voxels(frames, full, geometry.grid.shape, geometry.grid.half, outside='ignore')
    assert len(strict) < len(tolerant)


def test_valid_voxels_errors():
    geometry = scan()
    masked = random_masks(4, geometry.nDetector, np.random.default_rng(0))
    with pytest.raises(InputError, match='one a view'):
        valid_voxels(geometry.normalised_rays(), masked, (4, 4, 4), geometry.grid.half)
    with pytest.raises(InputError, match='outside'):
        valid_voxels(geometry.normalised_rays()[:4], masked, (4, 4, 4), geometry.grid.half, outside='clamp')


def test_occupancy_and_scaling():
    geometry = scan(nVoxel=(40, 40, 40), dVoxel=(0.05,) * 3, n=2)
    frames = geometry.normalised_rays()
    masked = random_masks(len(frames), geometry.nDetector, np.random.default_rng(4))
    expected = len(literal_filter(frames, masked.low, (16, 16, 16), geometry.grid.half)) / 16**3
    assert 0 < expected < 1
    assert occupancy(frames, masked, geometry.grid.half, geometry.grid.shape) == expected
    assert scale_factor(0.3) == 0.3 * 20 and scale_factor(0.01) == 1 and scale_factor(0.5, V_S=10) == 5
    assert scaled_grid((256, 256, 178), 2.5) == (102, 102, 71)
    assert scaled_grid((256, 256, 178), 1.0) == (256, 256, 178)
    assert scaled_grid((100, 20, 1), 20.0) == (8, 8, 1)


def test_occupancy_of_a_single_slice():
    geometry = scan(
        nVoxel=(40, 40, 1),
        dVoxel=(0.05,) * 3,
        nDetector=(1, 60),
        dDetector=(0.2, 0.09),
        offOrigin=(0.0, 0.0, 0.0),
        offDetector=(0.0, 0.0),
    )
    ones = np.ones((5, 1, 60), bool)
    assert (
        occupancy(
            geometry.normalised_rays(),
            Masks(ones, ones, np.zeros(5), np.zeros(5)),
            geometry.grid.half,
            geometry.grid.shape,
        )
        == 1
    )
