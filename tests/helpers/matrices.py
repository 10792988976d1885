"""Helpers of tests of Joseph's projector."""

import drjit as dr
import mitsuba as mi
import numpy as np


def matrix(geometry, axes: int = 2) -> np.ndarray:
    """Joseph's matrix, dense, [view * v * u, x * y * z], ray by ray and slice by slice in float64.

    axes   how many axes, from x on, may be the main one
    """
    frames, size, voxel = geometry.rays(), np.array(geometry.grid.shape), np.array(geometry.grid.spacing)
    first = np.array(geometry.grid.centre) + (voxel - geometry.grid.size) / 2
    rows = []
    for view in range(len(geometry)):
        for v in range(geometry.nDetector[0]):
            for u in range(geometry.nDetector[1]):
                o, d = frames.through(view, u + 0.5, v + 0.5)
                weights = np.zeros(size)
                main = int(np.argmax(abs(d / voxel)[:axes]))
                for m in range(size[main]):
                    t = (first[main] + m * voxel[main] - o[main]) / d[main]
                    p = (o + t * d - first) / voxel
                    if (p < -0.5).any() or (p > size - 0.5).any():
                        continue
                    p = np.clip(p, 0, size - 1)
                    path = voxel[main] * np.linalg.norm(d) / abs(d[main])
                    hats = [np.maximum(1 - abs(np.arange(n) - x), 0) for n, x in zip(size, p)]
                    weights += path * hats[0][:, None, None] * hats[1][:, None] * hats[2]
                rows.append(weights.ravel())
    return np.array(rows)


def device_images(y: np.ndarray):
    """Projections [view, v, u] as images of a projector."""
    return mi.Float(np.ascontiguousarray(y.transpose(0, 2, 1), np.float32).ravel())


def assert_pair(kind: type, geometry, matrix: np.ndarray, masked: bool) -> None:
    """Two views of a projector of three, and their transpose, agree with a dense matrix.

    masked   with a third of the pixels left out, whatever stands in them
    """
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=geometry.grid.shape), rng.normal(size=(3, *geometry.nDetector))
    valid = rng.random(y.shape) < (0.67 if masked else 2)
    A, J = matrix * valid.reshape(-1, 1), kind(geometry, valid if masked else None)
    views = [2, 0]
    rows = A.reshape(3, -1, A.shape[1])[views].reshape(-1, A.shape[1])
    ax, paths = J.forward(mi.Float(np.float32(x).ravel()), views)
    shape = (2, *geometry.nDetector[::-1])
    result = ax.numpy().reshape(shape).transpose(0, 2, 1).ravel()
    expected = rows @ x.ravel()
    assert np.count_nonzero(expected) > 15
    np.testing.assert_allclose(result, expected, atol=2e-5 * np.abs(expected).max())
    np.testing.assert_allclose(paths.numpy().reshape(shape).transpose(0, 2, 1).ravel(), rows.sum(1), atol=1e-3)
    expected = rows.T @ y[views].ravel()
    images = device_images(np.where(valid, y, np.nan)[views])
    aty, sums = J.adjoint(images, views), J.adjoint(images, views, lambda voxel, change, ones: ones)
    np.testing.assert_allclose(aty.numpy(), expected, atol=2e-5 * np.abs(expected).max())
    np.testing.assert_allclose(sums.numpy(), rows.sum(0), atol=2e-5 * rows.sum(0).max())


def assert_kernels_serve_any_views(A) -> None:
    """Require that one kernel projects and two go back (the first weights the images). A: a projector of three views or
    more."""
    x = dr.opaque(mi.Float, 1.0, A.voxels)

    def both(views):
        images = A.forward(x, views)[0]
        dr.eval(images)
        dr.eval(A.adjoint(images, views))

    both([0, 1])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        both([2])
        both([2, 0, 1])
        history = dr.kernel_history([dr.KernelType.JIT])
    assert len(history) == 6 and len({k['hash'] for k in history}) == 3 and all(k['cache_hit'] for k in history)
