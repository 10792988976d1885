"""Total variation of a fit's cloud, sampled in one random cube per step (R2-Gaussian, section 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting import losses
from lingo_mi.fitting.options.loss import Loss
from lingo_mi.fitting.view_loss import evaluate
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.replay import Replay
from lingo_mi.projectors.view import vector64
from lingo_mi.projectors.voxelize import Lattice, voxelize

FAR = 1e6  # in the normalised frame, where the longest side of the volume is 2


def random_cube_variation(
    gaussians: Sequence, geometry: Geometry, loss: Loss, extent: float, rng: np.random.Generator, factor: Any = None
) -> Any:
    """Total variation of a randomly placed cube of samples.

    Adds its gradient to the Gaussians'. Returns lambda_tv times its value, Float [1].

    Parameters
    ----------
    gaussians : Sequence
        Centres, standard deviations, quaternions and densities, with gradients enabled; normalised frame.
    loss : Loss
        Its weight of the variation, and the cube's samples.
    extent : float
        Cut-off in standard deviations.
    geometry : Geometry
        Its voxels; samples are `tv_stride` voxels apart and stay between the outermost voxel centres.
    factor
        The loss scale, Float [1]: multiplies the gradient, not the value that is returned; None: 1.
    """
    half = geometry.grid.half
    voxel, between = 2 * half / geometry.grid.shape, np.array(geometry.grid.shape) - 1
    shape = tuple(int(min(loss.tv_size, n // loss.tv_stride + 1)) for n in between)
    room = between - (np.array(shape) - 1) * loss.tv_stride
    corner = -half + (0.5 - 0.5 * loss.tv_stride + rng.random(3) * room) * voxel
    voxel = voxel * loss.tv_stride
    low, high, step = vector64(corner), vector64(corner + shape * voxel), vector64(voxel)
    settled = dict(shape=shape, extent=extent, weight=loss.lambda_tv)
    if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
        value, gradients = _REPLAY(*gaussians, low, high, step, factor, **settled)
        for x, gradient in zip(gaussians, gradients):
            dr.accum_grad(x, gradient)
        return value
    index: Any = dr.compress(_near(gaussians, low, high, extent))
    if dr.width(index) == 0:
        return mi.Float(0)
    chosen = [dr.gather(type(x), x, index, mode=dr.ReduceMode.NoConflicts) for x in gaussians]
    value = _differentiated(chosen, low, step, factor, **settled)
    evaluate(gaussians)
    return value


def _near(gaussians, low, high, extent):
    """Return the Gaussians that may reach into a box."""
    centre, scale = dr.detach(gaussians[0]), dr.detach(gaussians[1])
    reach = dr.max(scale) * extent
    return dr.all((centre + reach > mi.Vector3f(low)) & (centre - reach < mi.Vector3f(high)))


def _differentiated(gaussians, corner, step, factor, shape, extent, weight):
    """The value for a cube of samples, whose gradient it adds to the Gaussians'."""
    cube = voxelize(*gaussians, grid=Lattice(corner, step, shape), extent=extent)
    loss = weight * losses.tv(cube, shape[::-1])
    dr.backward(loss if factor is None else factor * loss)
    return dr.detach(loss)


def _replayed(*arrays, **settled):
    """The value for a cube, and its gradient, without waiting for the number of Gaussians in the cube.

    Those come first, in as many places as there are Gaussians. The rest of the places holds Gaussians far away.
    """
    *gaussians, low, high, step, factor = arrays
    near = _near(gaussians, low, high, settled['extent'])
    is_near, i = dr.select(near, mi.UInt32(1), 0), dr.arange(mi.UInt32, dr.width(near))
    place = dr.prefix_reduce(dr.ReduceOp.Add, is_near, exclusive=True)
    index, taken = dr.zeros(mi.UInt32, dr.width(near)), i < dr.sum(is_near)
    dr.scatter(index, i, place, near, mode=dr.ReduceMode.Permute)
    far = mi.Point3f(FAR), mi.Vector3f(1), mi.Vector4f(0, 0, 0, 1), mi.Float(0)
    chosen = [dr.select(taken, dr.gather(type(x), x, index, taken), away) for x, away in zip(gaussians, far)]
    dr.eval(chosen, place)
    dr.enable_grad(chosen)
    loss = _differentiated(chosen, low, step, factor, **settled)
    # Each gather alone would compute all derivatives. One kernel would need so many registers that few warps run at once.
    gradients = centre, scale, rotation, density = dr.grad(chosen)
    dr.eval(rotation)
    dr.eval(centre, scale, density)
    return loss, [dr.gather(type(x), x, place, near) for x in gradients]


_REPLAY = Replay(_replayed)
