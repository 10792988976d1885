"""Poses corrected together with the cloud: derivatives, recovery of known errors, checkpoints, and nothing when off."""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.fits import SHORT, geometry, some_points, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.corrections import poses as pose_correction
from lingo_mi.fitting.corrections.poses import Poses, gathered, place
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods import densities
from lingo_mi.fitting.state import start
from lingo_mi.geometry import Geometry, PosedGeometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors.backprop import leaves
from lingo_mi.scan import Scan

MOVING = SHORT.changed(rate_pose=(2e-3, 2e-4), lambda_tv=0.0)


def misaligned(g, seed=5, degrees=0.5, mm=1.0):
    """A geometry whose views are turned and shifted at random about the volume's centre; the motions have no mean."""
    rng = np.random.default_rng(seed)
    turn, shift = np.radians(degrees) * rng.normal(size=(len(g), 3)), mm * rng.normal(size=(len(g), 3))
    turn, shift = turn - turn.mean(0), shift - shift.mean(0)
    frames = g.rays().moved(Rotation.from_rotvec(turn).as_matrix(), shift)
    return Geometry.from_poses(frames, g.nDetector, nVoxel=g.grid.shape, dVoxel=g.grid.spacing), turn, shift


@pytest.mark.parametrize('mode', ['cone', 'parallel', 'curved'])
def test_derivatives_by_differences(mode):
    """Derivatives of the loss by the six numbers of a view's motion agree with differences, at a moved view."""
    flat = geometry(3, mode=mode.replace('curved', 'cone'))
    g = flat.curved(300.0) if mode == 'curved' else flat
    # Smooth, for differences: nothing is cut off, and the measured views are above the rendered ones everywhere (L1).
    stepper = MOVING.changed(extent=7).stepper(Scan(g, tiny_scan(flat).projections + 50))
    [correction] = stepper.corrections
    moved = correction.poses
    points = some_points(g, 40)
    state = DeviceState(start(points.points, points.spacing * 2, points.density, stepper.forward))
    target = stepper.targets[1]
    moved.turn[1], moved.shift[1] = [0.02, -0.03, 0.05], [0.01, 0.02, -0.03]
    here = moved.correct(target.rays, 1)

    def loss(move):
        frames = here.moved(Rotation.from_rotvec(move[:3]).as_matrix(), move[3:])
        place(target.view, frames)
        leaf = leaves(stepper.forward.gaussians(state.values))
        return float(stepper.compare(leaf, target, 1)[0][0])

    loss(np.zeros(6))
    poses = Poses(3)
    # Adam without memory: its first moment is the derivative.
    poses.step(1, here, gathered(target.view), 1e-3, SimpleNamespace(beta1=0.0, beta2=0.0, epsilon=0.0))
    h = 1e-3
    expected = [(loss(h * e) - loss(-h * e)) / (2 * h) for e in np.eye(6)]
    np.testing.assert_allclose(poses.first[1], expected, rtol=5e-3, atol=5e-3 * np.abs(expected).max())
    assert np.count_nonzero(np.abs(expected) > 0.01 * np.abs(expected).max()) >= 5


def test_motions_of_all_views_are_the_objects():
    """Steps change the relative poses of the views and leave their mean where it was."""
    g, rng = geometry(5), np.random.default_rng(0)
    poses, frames = Poses(5), g.normalised_rays()
    for i in range(40):
        view = i % 5
        by = rng.normal(size=(4, 3))
        poses.step(view, poses.correct(frames[[view]], view), by, 1e-2, MOVING.rates)
    np.testing.assert_allclose(poses.shift.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(poses.turn.mean(0), 0, atol=1e-4)  # rotations add up to first order
    assert np.abs(poses.turn).max() > 0.02 and np.abs(poses.shift).max() > 0.02
    flat = Poses(5, flat=True)
    flat.step(1, frames[[1]], by, 1e-2, MOVING.rates)
    assert not flat.turn[:, :2].any() and not flat.shift[:, 2].any() and flat.turn[1, 2] and flat.shift[1, :2].all()


def recovered(views, iterations, points):
    """Errors of the poses before and after a correction, errors of the views without and with it, and the two fits."""
    g = geometry(views, angles=circular(views, 360, start=10))
    true, turn, shift = misaligned(g)
    scan = Scan(g, tiny_scan(true).projections)
    method = SHORT.changed(iterations=iterations, densify_from=10**6, lambda_tv=0.0)
    fits = [run(scan, method.changed(n=points, rate_pose=rate), seed=3) for rate in ((0.0, 0.0), (2e-3, 2e-4))]
    poses = fits[1].poses

    def rms(x):
        return float(np.sqrt(np.mean(np.square(x))))

    before = np.degrees(rms(turn)), rms(shift)
    after = np.degrees(rms(poses.turn - turn)), rms(poses.shift / g.grid.scale - shift)
    errors = [rms(f.render(f.geometry) - scan.projections) / rms(scan.projections) for f in fits]
    return before, after, errors, fits


def test_errors_of_a_millimetre_and_half_a_degree_are_found():
    before, after, errors, (off, on) = recovered(views=8, iterations=400, points=60)
    assert before[0] > 0.4 and before[1] > 0.8  # the means are taken off: no scan tells them
    assert after[0] < 0.3 * before[0] and after[1] < 0.5 * before[1]
    assert errors[1] < 0.4 * errors[0]
    assert off.geometry is off.nominal_geometry
    assert isinstance(on.geometry, PosedGeometry)
    assert np.abs(on.geometry.rays().source - on.nominal_geometry.rays().source).max() > 0.5


def test_checkpoints_keep_the_poses(tmp_path, sums_in_order):
    scan = tiny_scan(geometry(3))
    method = MOVING.changed(iterations=12)
    whole = run(scan, method, seed=3)
    path = tmp_path / 'checkpoint.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, method, seed=3, progress=stop_at(7), path=path)
    again = run(scan, method, seed=3, path=path, resume=True)
    for name, values in whole.poses.arrays().items():
        np.testing.assert_array_equal(again.poses.arrays()[name], values)
    assert whole.poses.turn.any() and whole.poses.shift.any()


def test_poses_left_alone_compile_nothing_new(monkeypatch):
    """A fit without corrections runs as if there were none; a second view compiles nothing."""
    scan = tiny_scan(geometry(3))

    def kernels(method):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            dr.kernel_history_clear()
            run(scan, method, seed=3)
            return [k['hash'] for k in dr.kernel_history([dr.KernelType.JIT])]

    short = SHORT.changed(iterations=6, densify_from=100, lambda_tv=0.0)
    off = kernels(short)
    on = kernels(short.changed(rate_pose=(1e-3, 1e-4)))
    with monkeypatch.context() as patch:  # neither placing nor moving
        for name in ('place', 'gathered'):
            patch.delattr(pose_correction, name)
        for name in ('Poses', 'PoseCorrection'):
            patch.delattr(densities, name)
        bare = kernels(short)
    assert off == bare and set(on) - set(off)
    assert len(set(kernels(short.changed(rate_pose=(1e-3, 1e-4), iterations=9)))) == len(set(on))


@pytest.mark.parametrize('rate', [(1e-3, 0.0), (-1e-3, -1e-4), (1e-3,)])
def test_bad_rates(rate):
    with pytest.raises(InputError, match='rate_pose (must be two positive numbers|must lie in|takes two numbers)'):
        SHORT.changed(rate_pose=rate)
