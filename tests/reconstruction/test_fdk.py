"""Filtered backprojection: densities, positions, spans, filters, and a measured fan-beam scan."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from helpers.balls import BALL, centres, ellipsoids, geometry
from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.reconstruction.fdk import FDK, WINDOWS, filtered, ramp, ray_weights, view_weights
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan


def test_asymmetric_phantom_axis_by_axis():
    geo = geometry(angles=circular(120))
    axes = np.array([12.0, 12.0, 12.0])
    bodies = [
        (np.array([30.0, 0.0, 0.0]), axes, 0.01),
        (np.array([0.0, 30.0, 0.0]), axes, 0.02),
        (np.array([0.0, 0.0, 30.0]), axes, 0.03),
        (np.array([0.0, -30.0, 0.0]), axes, 0.04),
    ]
    volume, x = run_algorithm(ellipsoids(geo, *bodies), FDK()).volume, centres(geo)
    for centre, _, density in bodies:
        inside = np.linalg.norm(x - centre, axis=-1) < 7
        assert abs(volume[inside].mean() / density - 1) < 0.06  # a cone misses data off the central plane
        opposite = np.linalg.norm(x + centre * [1, 0, 1], axis=-1) < 7
        if centre[1] == 0:
            assert abs(volume[opposite].mean()) < 0.2 * density


@pytest.mark.parametrize('span', [215, 230, 280])
def test_parker_weights_on_a_short_scan(span):
    """A panel that spans 31 degrees of fan needs views over 211. Rays that are measured twice must not count twice."""
    geo = geometry(angles=circular(span, span, start=40)[::-1])
    volume, near = run_algorithm(ellipsoids(geo, BALL), FDK()).volume, np.linalg.norm(centres(geo) - BALL[0], axis=-1)
    assert np.sqrt(np.mean((volume[near < 20] / 0.02 - 1) ** 2)) < 0.005  # unweighted: 0.02 to 0.04
    assert np.sqrt(np.mean((volume[(near > 30) & (near < 60)] / 0.02) ** 2)) < 0.025  # unweighted: above 0.05


@pytest.mark.parametrize('span', [211, 240, 300])
def test_parker_weights_of_opposite_rays_sum_to_one(span):
    n, u = 4 * span, (np.arange(72) - 35.5) * 3 - 6  # so that -u is a column too
    geo = geometry(angles=circular(n, span), offDetector=(4.0, -6.0))
    weights = ray_weights(geo) * np.pi / np.radians(span)
    fan = np.arctan(u / 450)
    for column in (4, 30, 36, 60):
        other = np.interp(-fan[column], fan, np.arange(72))
        partner = geo.angles + np.pi - 2 * fan[column]
        pairs = np.interp(partner, geo.angles, weights[:, round(other)], left=0, right=0)
        seen = (partner > geo.angles[2]) & (partner < geo.angles[-3])
        if abs(other - round(other)) < 1e-6:
            np.testing.assert_allclose(weights[seen, column] + pairs[seen], 1, atol=0.01)
            assert seen.sum() > 10
    np.testing.assert_allclose(ray_weights(geometry(angles=circular(190, 190))), 1)  # less than the fan needs
    np.testing.assert_allclose(ray_weights(geometry(angles=[0.3])), 1)


def test_parker_weights_branch_by_branch():
    """The weights are Parker's and Silver's, with the half excess d and the fan angle g towards the side that is seen again
    last."""
    n, span = 36, np.radians(240)
    geo = geometry(angles=circular(n, 240), offDetector=(0.0, 0.0))
    g, d = np.arctan((np.arange(72) - 35.5) * 3 / 450), (span - np.pi) / 2
    for view, weights in enumerate(ray_weights(geo) * np.pi / span):
        beta = (view + 0.5) * span / n
        rising, falling = beta < 2 * (d + g), beta > np.pi + 2 * g
        expected = np.ones(72)
        expected[rising] = np.sin(np.pi / 4 * beta / (d + g[rising])) ** 2
        expected[falling] = np.sin(np.pi / 4 * (np.pi + 2 * d - beta) / (d - g[falling])) ** 2
        np.testing.assert_allclose(weights, expected, atol=1e-12)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('offset', [50.0, -50.0])
def test_offset_detector_that_sees_little_more_than_half(mode, offset):
    geo = geometry(mode, nDetector=(64, 40), offDetector=(4.0, offset))  # from -10 to 110 mm
    volume, near = run_algorithm(ellipsoids(geo, BALL), FDK()).volume, np.linalg.norm(centres(geo) - BALL[0], axis=-1)
    assert abs(volume[near < 12].mean() / 0.02 - 1) < 0.005  # unweighted: 0.36
    assert np.sqrt(np.mean((volume[near < 20] / 0.02 - 1) ** 2)) < 0.02
    weights = ray_weights(geo)[0]
    u = (np.arange(40) - 19.5) * 3 + offset
    overlap = np.abs(u) < 10
    np.testing.assert_allclose(weights[~overlap], 2)
    np.testing.assert_allclose(weights[overlap] + np.interp(-u[overlap], *zip(*sorted(zip(u, weights)))), 2, atol=0.05)


@pytest.mark.parametrize('views', [np.delete(np.arange(60), 7), np.round(np.arange(40) * 1.5).astype(int)])
def test_offset_detector_with_views_left_out(views):
    """A circle without a view or every third one is closed: opposite views still complete the panel."""
    geo = geometry(nDetector=(64, 40), offDetector=(4.0, 50.0), angles=circular(60)[views])
    volume, near = run_algorithm(ellipsoids(geo, BALL), FDK()).volume, np.linalg.norm(centres(geo) - BALL[0], axis=-1)
    assert abs(volume[near < 12].mean() / 0.02 - 1) < 0.03


@pytest.mark.parametrize('values', [0.0, 1.0, -1.0])
def test_constant_projections(values):
    geo = geometry(angles=circular(6))
    scan = Scan(geo, np.full((6, *geo.nDetector), values))
    volume = FDK()._run(scan).volume  # `run_algorithm` refuses a scan without signal
    assert np.isfinite(volume).all() and (volume.any() == bool(values))


@pytest.mark.parametrize('mode, span', [('cone', 180), ('cone', 230), ('parallel', 180), ('parallel', 230)])
def test_shorter_spans_keep_the_density(mode, span):
    geo = geometry(mode, circular(span // 2, span))
    volume, near = run_algorithm(ellipsoids(geo, BALL), FDK()).volume, np.linalg.norm(centres(geo) - BALL[0], axis=-1)
    assert abs(volume[near < 12].mean() / 0.02 - 1) < 0.06


def test_filters_keep_the_density():
    scan = ellipsoids(geometry(angles=circular(60)), BALL)
    near = np.linalg.norm(centres(scan.geometry) - BALL[0], axis=-1)
    for name in WINDOWS:
        assert abs(run_algorithm(scan, FDK(name)).volume[near < 10].mean() / 0.02 - 1) < 0.02, name
        assert ramp(64, 1.0, name)[-1] <= ramp(64, 1.0)[-1] + 1e-12
    with pytest.raises(InputError, match='ram-lak'):
        FDK('ramlak')


def test_windows():
    """They are right at zero, half and the whole of the Nyquist frequency."""
    f = np.array([0, 0.5, 1])
    for name, expected in {
        'ram-lak': [1, 1, 1],
        'shepp-logan': [1, np.sin(np.pi / 4) / (np.pi / 4), 2 / np.pi],
        'cosine': [1, np.sqrt(0.5), 0],
        'hamming': [1, 0.54, 0.08],
        'hann': [1, 0.5, 0],
    }.items():
        np.testing.assert_allclose(WINDOWS[name](f), expected, atol=1e-15, err_msg=name)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_filtering_in_other_units(mode):
    """If all lengths are twice as long, cosines stay, and values per mm are half as large."""
    once = geometry(mode, circular(3))
    lengths = 'DSO', 'DSD', 'dDetector', 'offDetector'
    grid = replace(once.grid, spacing=np.multiply(once.grid.spacing, 2), centre=np.multiply(once.grid.centre, 2))
    twice = replace(once, grid=grid, **{name: np.multiply(getattr(once, name), 2) for name in lengths})
    projections = np.random.default_rng(0).random((3, *once.nDetector), dtype=np.float32)
    actual, expected = filtered(projections, twice), filtered(projections, once) / 2
    np.testing.assert_allclose(actual, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize('side', ['u', 'v'])
def test_the_cosine_is_that_of_the_offset_panel(side):
    """FDK weighs a row far from the axis by DSD over the ray's length to each pixel."""
    offset = (0.0, 60.0) if side == 'u' else (60.0, 0.0)
    geo = geometry(angles=[0.0], nDetector=(1, 1), dDetector=(2.0, 3.0), offDetector=offset)
    centred = geometry(angles=[0.0], nDetector=(1, 1), dDetector=(2.0, 3.0), offDetector=(0.0, 0.0))
    one = np.ones((1, 1, 1), np.float32)
    ratio = filtered(one, geo) / filtered(one, centred)
    np.testing.assert_allclose(ratio, 450 / np.hypot(450, 60), rtol=1e-5)


def test_view_weights():
    full = view_weights(geometry(angles=circular(8)))
    np.testing.assert_allclose(full, np.pi / 8)
    np.testing.assert_allclose(view_weights(geometry(angles=circular(8, 180))), np.pi / 8)
    np.testing.assert_allclose(view_weights(geometry('parallel', circular(8))), np.pi / 8)
    uneven = np.array([0.0, 0.5, 1.2, 2.0, 2.6])  # a parallel beam comes back to its first view after half a turn
    gap = np.diff(uneven, append=np.pi)
    np.testing.assert_allclose(view_weights(geometry('parallel', uneven)), (gap + np.roll(gap, 1)) / 2)
    limited = view_weights(geometry(angles=circular(9, 90)))
    np.testing.assert_allclose(limited, np.radians(10))
    np.testing.assert_allclose(view_weights(geometry(angles=[1.0])), np.pi)
    doubled = view_weights(geometry(angles=np.append(circular(8), 2 * np.pi)))  # the first view twice
    np.testing.assert_allclose(doubled.sum(), np.pi)
    np.testing.assert_allclose(doubled[0] + doubled[-1], np.pi / 8)
    shuffled = np.random.default_rng(0).permutation(8)
    np.testing.assert_allclose(view_weights(geometry(angles=circular(8)[shuffled])), full)
    np.testing.assert_allclose(view_weights(geometry(angles=circular(24, 1080))), np.pi / 24)  # three turns
    np.testing.assert_allclose(view_weights(geometry('parallel', circular(16, 720))), np.pi / 16)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_matrices_agree_with_the_frames(mode):
    geo = geometry(mode, circular(5, start=20))
    ijk = np.random.default_rng(0).integers(0, 28, (20, 3))
    points = (ijk + 0.5) * geo.grid.spacing - np.array(geo.grid.size) / 2 + geo.grid.centre
    for view, matrix in enumerate(geo.voxel_matrices()):
        x, y, w = matrix @ np.c_[ijk, np.ones(20)].T
        expected = geo.rays().project(points, view)
        np.testing.assert_allclose((x / w, y / w), expected, rtol=1e-10)
        out = [np.cos(geo.angles[view]), np.sin(geo.angles[view]), 0]
        np.testing.assert_allclose(w, 1 - points @ out / 300 if mode == 'cone' else 1, rtol=1e-10)


def test_filters_by_tigres_names():
    for name in 'ram_lak', 'shepp_logan':
        np.testing.assert_array_equal(ramp(9, 1.0, name), ramp(9, 1.0, name.replace('_', '-')))
    with pytest.raises(InputError, match='unknown'):
        ramp(9, 1.0, 'box_car')


def test_one_kernel_for_all_views():
    scan = ellipsoids(geometry(angles=circular(10)), BALL)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        run_algorithm(scan, FDK())
        history = dr.kernel_history([dr.KernelType.JIT])
    assert len({kernel['hash'] for kernel in history}) == 1 and len(history) == 3


def test_fan_beam_of_one_row():
    geo = geometry(
        nDetector=(1, 72),
        nVoxel=(36, 36, 1),
        dVoxel=(4.0, 4.0, 2.0),
        offOrigin=(0.0, 0.0, 0.0),
        offDetector=(0.0, -7.0),
    )
    volume = run_algorithm(
        ellipsoids(geo, (np.array([12.0, -9.0, 0.0]), np.array([25.0, 25.0, 25.0]), 0.02)), FDK()
    ).volume
    near = np.linalg.norm(centres(geo) - [12.0, -9.0, 0.0], axis=-1)
    assert abs(volume[near < 12].mean() / 0.02 - 1) < 0.01


def test_measured_fan_beam(data):
    file = data / 'htc2022_fan.npz'
    if not file.exists():
        pytest.skip(f'LINGO_MI_DATA holds no {file.name}')
    data = np.load(file)
    voxel = 0.1483
    angles = np.radians(data['angles_deg'][:-1])  # the last view repeats the first
    geo = CircularGeometry(
        DSO=float(data['DSO']),
        DSD=float(data['DSD']),
        nDetector=(1, 560),
        dDetector=float(data['dDetector']),
        angles=angles,
        grid=Grid((512, 512, 1), voxel),
    )
    volume = run_algorithm(Scan(geo, data['sinogram_ta'][:-1, None]), FDK()).volume[..., 0]
    reference = data['fbp_ta']
    assert np.corrcoef(volume.ravel(), reference.ravel())[0, 1] > 0.99
    disc = reference > 0.7 * reference.max()
    assert abs(volume[disc].mean() * voxel / reference[disc].mean() - 1) < 0.02


def test_all_four_edges_of_the_panel_are_alike():
    """Voxel centres on an edge, to the last bit, are not seen, whichever edge it is."""
    geo = CircularGeometry(
        DSO=8.0, DSD=8.0, nDetector=(4, 4), dDetector=1.0, angles=[0.0], mode='parallel', grid=Grid((3, 5, 5), 1.0)
    )
    volume = run_algorithm(Scan(geo, np.ones((1, 4, 4), np.float32)), FDK()).volume
    assert (volume[:, 1:-1, 1:-1] != 0).all()
    volume[:, 1:-1, 1:-1] = 0
    assert not volume.any()
