"""The projector of a cloud's densities as a linear map, A and its transpose."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.functional.linear_map import LinearMap
from lingo_mi.functional.operators import checked_extent, gaussians_of
from lingo_mi.geometry import Geometry
from lingo_mi.projectors import cutoff
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.upload import uploaded_tensor
from lingo_mi.projectors.view import View


class GaussianProjector(LinearMap):
    """Line integrals of N Gaussians as a function of their densities, A, and its transpose A.T.

    `A(density)` takes the values at the centres, [N], and returns line integrals [view, v, u], as `lm.project` does.
    `A.T(images)` returns a number for each Gaussian: the sum over all pixels of the pixel's value times the line integral of this
    Gaussian with density 1. Both are linear, because places and shapes are fixed. They take and return arrays of NumPy, Dr.Jit,
    PyTorch or JAX, with leading batch axes, and are differentiable in them. For derivatives with respect to centres, scales and
    rotations, use `lm.project`.

    Parameters
    ----------
    means, scales : array
        [N, 3] centres and standard deviations, mm.
    quaternions : array
        [N, 4] rotations, (x, y, z, w).
    geometry : Geometry
        The scanner.
    extent : float
        Cut-off in standard deviations, 1 to 20.

    Attributes
    ----------
    geometry : Geometry
    domain_shape, range_shape : tuple of int
        (N,) and (view, v, u).

    Raises
    ------
    InputError
        For arrays of other shapes, an empty cloud, a Gaussian that is not finite, has no extent or no rotation, and another type
        of geometry.

    Examples
    --------
    Densities from images, by least squares:

    >>> import numpy as np, lingo_mi as lm
    >>> from scipy.sparse.linalg import lsqr
    >>> scan = lm.Geometry.parallel(nDetector=(16, 16), dDetector=1, nVoxel=16, dVoxel=1, angles=lm.circular(6))
    >>> means, scales, turns = np.float32([[2, 0, 1], [-3, 2, -2]]), np.ones((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1))
    >>> A = lm.GaussianProjector(means, scales, turns, scan)
    >>> lsqr(A.aslinearoperator(), A([0.5, 2.0]).ravel())[0].round(4).tolist()
    [0.5, 2.0]
    """

    def __init__(
        self,
        means: ArrayLike,
        scales: ArrayLike,
        quaternions: ArrayLike,
        geometry: Geometry,
        *,
        extent: float = cutoff.RENDER,
    ):
        require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
        shapes = dict(means=(means, 3), scales=(scales, 3), quaternions=(quaternions, 4))
        self._arrays = [as_numpy(values, name, np.float32) for name, (values, _) in shapes.items()]
        count = len(self._arrays[0]) if self._arrays[0].ndim else 0
        for array, (name, (_, width)) in zip(self._arrays, shapes.items()):
            if array.shape != (count, width):
                wanted = 'N' if name == 'means' else count
                raise InputError(f'{name} must be of the shape [{wanted}, {width}], not {list(array.shape)}')
        if count == 0:
            raise InputError('the cloud is empty: it needs at least one Gaussian')
        self.geometry, self._options = geometry, RenderOptions(checked_extent(extent))
        self.domain_shape, self.range_shape = (count,), (len(geometry), *geometry.nDetector)
        self._built: dict[str, list] = {}  # by Mitsuba's variant
        ensure_variant()
        self._cloud()

    @cached_property
    def T(self) -> LinearMap:
        """The transpose: images [..., view, v, u] to densities [..., N]."""
        return _Transpose(self)

    def __repr__(self) -> str:
        shape = ' x '.join(map(str, self.range_shape))
        return f'GaussianProjector({self.domain_shape[0]} Gaussians to {shape} pixels)'

    def on_device(self, x: Any) -> Any:
        images = dr.concat([self._image(x, view) for view in self._views()])
        dr.eval(images)
        return images

    def by_density(self, y: Any) -> Any:
        """Apply the transpose to evaluated pixels on the device: `A.T.on_device`.

        It is the derivative, by the densities, of the product of the images and `y`.

        Parameters
        ----------
        y : mi.Float
            Pixels of all images, flat.

        Returns
        -------
        mi.Float [N]
            A value for each Gaussian.
        """
        pixels = self.range_shape[1] * self.range_shape[2]
        index = dr.arange(mi.UInt32, pixels)
        out = dr.zeros(mi.Float, self.domain_shape[0])
        for i, view in enumerate(self._views()):
            density = dr.opaque(mi.Float, 1, self.domain_shape[0])
            dr.enable_grad(density)
            upstream = dr.gather(mi.Float, y, index + dr.opaque(mi.UInt32, i * pixels))
            dr.backward(self._image(density, view, primal=False) * upstream)
            out += dr.grad(density)
            dr.eval(out)
        return dr.select(dr.any(dr.isnan(y)), dr.nan, out)  # Dr.Jit's sums leave NaN out on a CPU

    def _image(self, density: Any, view: View, primal: bool = True) -> Any:
        centre, scale, rotation = self._cloud()
        return line_integrals(centre, scale, rotation, density, view, self._options, primal)

    def _views(self):
        rays = self.geometry.rays(curved=True)
        return (View.of(rays, i, *self.geometry.nDetector) for i in range(len(rays)))

    def _cloud(self) -> list:
        """Centres, scales and rotations on the device of the active variant."""
        variant = mi.variant() or ensure_variant()
        if variant not in self._built:
            ones = np.ones(self.domain_shape, np.float32)
            tensors = [uploaded_tensor(x) for x in (*self._arrays, ones)]
            self._built[variant] = gaussians_of(tensors, 'GaussianProjector')[:3]
        return self._built[variant]


class _Transpose(LinearMap):
    def __init__(self, projector: GaussianProjector):
        self._projector = projector
        self.domain_shape, self.range_shape = projector.range_shape, projector.domain_shape

    @property
    def T(self) -> GaussianProjector:
        return self._projector

    def on_device(self, x: Any) -> Any:
        return self._projector.by_density(x)

    def __repr__(self) -> str:
        return f'{self._projector!r}.T'
