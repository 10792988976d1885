"""Rings and outliers of raw frames: gains that changed since the flats are found, and a sound scan is hardly changed."""

import numpy as np
import pytest

import lingo_mi as lm
from helpers.raw_frames import raw_frames
from lingo_mi.geometry import Geometry, circular
from lingo_mi.metrics.quality import psnr_3d
from lingo_mi.raw.line_integrals import bright_outliers
from lingo_mi.raw.rings import LEAST_COLUMNS, LEAST_VIEWS, ring_offsets

SIZE, COLUMNS, COUNTS = 96, 320, 40_000


def slice_of(views):
    """A fan-beam scan of a slice of the foot, without noise."""
    foot = lm.phantom('foot', size=SIZE, attenuation='real')
    step = foot.spacing[0]
    side = SIZE * step
    geometry = Geometry.cone(
        angles=circular(views, 360),
        DSO=3 * side,
        DSD=4.5 * side,
        nDetector=(1, COLUMNS),
        dDetector=(1.5 * step, 2.4 * side / COLUMNS),
        nVoxel=(SIZE, SIZE, 1),
        dVoxel=step,
    )
    return lm.simulate(np.ascontiguousarray(foot.data[:, :, [SIZE // 2]]), geometry, progress=False)


@pytest.fixture(scope='module')
def data():
    return slice_of(90)


def frames_of(data, gain, folder):
    """Frames whose pixels have other gains than in the flats."""
    rng = np.random.default_rng(1)
    views = rng.poisson(COUNTS * (1 + gain) * np.exp(-data.train.projections)).astype(np.uint16)
    folder.mkdir()
    np.save(folder / 'views.npy', views)
    np.save(folder / 'flats.npy', np.full((1, 1, COLUMNS), COUNTS, np.uint16))
    return folder


def error(scan, truth):
    return psnr_3d(lm.reconstruct(scan, lm.FDK(), progress=False).volume, truth)


def test_gains_that_changed_make_rings_which_are_removed(data, tmp_path):
    """Gains of 3 % cost 7.5 dB, and all but 0.2 dB of that comes back; a sound scan loses nothing."""
    geometry, gain = data.train.geometry, np.random.default_rng(0).normal(0, 0.03, (1, COLUMNS))

    def load(gain, name, **options):
        folder = frames_of(data, gain, tmp_path / name)
        return lm.load_raw(folder / 'views.npy', geometry, flats=folder / 'flats.npy', progress=False, **options)

    sound, dirty = load(0 * gain, 'sound'), load(gain, 'dirty')
    cleaned, unharmed = load(gain, 'cleaned', rings=True), load(0 * gain, 'unharmed', rings=True)
    best, with_rings, without, after = (error(scan, data.volume) for scan in (sound, dirty, cleaned, unharmed))
    assert with_rings < best - 5
    assert without > best - 0.1 * (best - with_rings) and without > best - 1
    assert after > best - 0.05
    change = sound.projections - unharmed.projections
    noise = sound.projections - data.train.projections
    assert np.sqrt(np.square(change).mean()) < 0.5 * np.sqrt(np.square(noise).mean())


def test_invalid_pixels_make_no_offsets():
    rng = np.random.default_rng(0)
    p = rng.normal(0, 0.01, (LEAST_VIEWS, 2, LEAST_COLUMNS)).astype(np.float32)
    valid = np.ones(p.shape, bool)
    valid[:, 0, 50] = False
    valid[3] = False
    p[~valid] = 100
    offsets = ring_offsets(p, valid)
    assert offsets[0, 50] == 0
    assert np.abs(offsets).max() < 0.02


@pytest.mark.parametrize('shape', [(LEAST_VIEWS - 1, 2, LEAST_COLUMNS), (LEAST_VIEWS, 2, LEAST_COLUMNS - 1)])
def test_few_views_or_columns_are_refused(shape):
    with pytest.raises(lm.InputError, match=f'in {shape[0]} of {shape[2]}: leave rings out'):
        ring_offsets(np.zeros(shape, np.float32))


def test_import_refuses_before_it_reads(tmp_path):
    raw = raw_frames()
    np.save(tmp_path / 'views.npy', raw.views)
    geometry = Geometry.cone(
        angles=circular(6), DSO=100, DSD=150, nDetector=raw.views.shape[1:], dDetector=1, nVoxel=16, dVoxel=1
    )
    with pytest.raises(lm.InputError, match='leave rings out'):
        lm.load_raw(tmp_path / 'views.npy', geometry, i0=2e4, rings=True, progress=False)
    with pytest.raises(lm.InputError, match='rings must be'):
        lm.load_raw(tmp_path / 'views.npy', geometry, i0=2e4, rings='yes', progress=False)


def test_zingers_are_left_out_and_a_crack_is_not(tmp_path):
    raw = raw_frames(noise=True)
    rng = np.random.default_rng(5)
    views = raw.views.copy()
    hit = np.zeros(views.shape, bool)
    for view in hit:
        at = rng.integers(2, 20, 2)
        view[at[0] : at[0] + 2, at[1] + 10 : at[1] + 12] = True
    hit &= ~raw.bad
    views[hit] = 60_000
    for name, stack in dict(views=views, flats=raw.flats, darks=raw.darks).items():
        np.save(tmp_path / f'{name}.npy', stack)
    geometry = Geometry.cone(
        angles=circular(6), DSO=100, DSD=150, nDetector=views.shape[1:], dDetector=1, nVoxel=16, dVoxel=1
    )
    files = dict(flats=tmp_path / 'flats.npy', darks=tmp_path / 'darks.npy')
    scan = lm.load_raw(tmp_path / 'views.npy', geometry, **files, outliers=True, progress=False)
    np.testing.assert_array_equal(~scan.valid, hit | raw.bad)

    crack = np.full((40, 40), 1000.0)
    crack[:, 20] = 3000.0
    crack[10, 10] = 3000.0
    actual = bright_outliers(crack, np.full(crack.shape, 1e4), np.ones(crack.shape, bool))
    assert np.argwhere(actual).tolist() == [[10, 10]]
