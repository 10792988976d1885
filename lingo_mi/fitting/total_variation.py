"""Total variation of a fit's cloud, sampled in one random cube per step (R2-Gaussian, section 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting import losses
from lingo_mi.fitting.settings import Settings
from lingo_mi.fitting.view_loss import evaluate
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.replay import Replay
from lingo_mi.projectors.view import vector64
from lingo_mi.projectors.voxelize import Grid, voxelize


def random_cube_variation(
    gaussians: Sequence, geometry: Geometry, settings: Settings, rng: np.random.Generator, factor: Any = None
) -> Any:
    """Total variation of a randomly placed cube of samples.

    Adds its gradient to the Gaussians'. Returns lambda_tv times its value, Float [1].

    gaussians   centres, standard deviations, quaternions and densities, with gradients enabled; normalised frame
    geometry    its voxels; samples are `tv_stride` voxels apart and stay between the outermost voxel centres
    factor      on the loss (`loss_scale`), Float [1], which the gradient has and the value has not; None: 1
    """
    s, half, extent = settings.loss, geometry.half, settings.model.extent
    voxel, between = 2 * half / geometry.nVoxel, np.array(geometry.nVoxel) - 1
    nx, ny, nz = (int(min(s.tv_size, n // s.tv_stride + 1)) for n in between)
    shape = nx, ny, nz
    room = between - (np.array(shape) - 1) * s.tv_stride
    corner = -half + (0.5 - 0.5 * s.tv_stride + rng.random(3) * room) * voxel
    voxel = voxel * s.tv_stride
    low, high, step = vector64(corner), vector64(corner + shape * voxel), vector64(voxel)
    settled = dict(shape=shape, extent=extent, weight=s.lambda_tv)
    if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
        # All Gaussians: the number of those in the cube would have to be waited for, and would differ from step to step.
        loss, gradients = _REPLAY(*gaussians, low, step, factor, **settled)
        for x, gradient in zip(gaussians, gradients):
            dr.accum_grad(x, gradient)
        return loss
    with dr.suspend_grad():
        centre, scale = dr.detach(gaussians[0]), dr.detach(gaussians[1])
        reach = dr.max(scale) * extent
        near = dr.all((centre + reach > mi.Vector3f(low)) & (centre - reach < mi.Vector3f(high)))
        index: Any = dr.compress(near)
    if dr.width(index) == 0:
        return mi.Float(0)
    chosen = [dr.gather(type(x), x, index, mode=dr.ReduceMode.NoConflicts) for x in gaussians]
    loss = _differentiated(chosen, low, step, factor, **settled)
    evaluate(gaussians)
    return loss


def _differentiated(gaussians, corner, step, factor, shape, extent, weight):
    """The value for a cube of samples, whose gradient it adds to the Gaussians'."""
    cube = voxelize(*gaussians, grid=Grid(corner, step, shape), extent=extent)
    loss = weight * losses.tv(cube, shape[::-1])
    dr.backward(loss if factor is None else factor * loss)
    return dr.detach(loss)


def _replayed(*arrays, **settled):
    *gaussians, corner, step, factor = arrays
    dr.enable_grad(gaussians)
    loss = _differentiated(gaussians, corner, step, factor, **settled)
    return loss, [dr.grad(x) for x in gaussians]


_REPLAY = Replay(_replayed)
