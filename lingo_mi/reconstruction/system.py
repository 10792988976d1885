"""The linear system A x = b of a scan on the device, used by all iterative algorithms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.fastest import projector_class
from lingo_mi.projectors.grid_pair import GridPair
from lingo_mi.reconstruction.parameters import check_bound
from lingo_mi.reconstruction.preconditions import require_rays
from lingo_mi.reconstruction.wide_pixels import Between
from lingo_mi.scan import Scan

PARTIAL = 4096  # terms of the partial sums in float32
DIVERGED = 'the reconstruction is not finite: lower lmbda or alpha, or check the projections'


class System:
    """A x = b of a scan. Images are mi.Float [view, u, v]; projections are density times mm.

    Invalid pixels count for nothing.

    Attributes
    ----------
    A
        The projector.
    measured
        The projections.
    b
        The projections, `measured` or as corrected by `correct`.
    weights
        Weights of the voxels [x, y, z], for `sart.sweep`; `weighed`: their line integrals. None: no weights.
    blur
        For `sart.sweep`.
    between
        Voxels that no ray crosses (`wide_pixels.Between`), or None.
    """

    def __init__(self, scan: Scan, weights: ArrayLike | None = None, blur: Sequence[float] | None = None):
        require_rays(scan.geometry)
        self.geometry, self.valid = scan.geometry, scan.valid
        self.A = projector_class(scan.geometry)(scan.geometry, scan.valid)
        self.views = np.arange(len(scan))
        self.b = self.measured = self.A.images(scan.projections)
        self.size_b = norm(self.b) or 1.0
        self.between = Between.of(self.geometry, self.A, self.views)
        self.weights = self.weighed = None
        self.blur = None
        if blur is not None:
            if np.shape(blur) != (3,):
                raise InputError(f'blur must be three standard deviations, along x, y, z, not {blur!r}')
            for deviation in blur:
                check_bound('blur', deviation)
            if any(blur):
                self.blur = tuple(blur)
        if weights is not None:
            self.weights = self._device(weights, 'weights of the voxels')
            if dr.min(self.weights)[0] < 0:
                raise InputError('the weights of the voxels must not be negative')
            self.weighed = evaluated(self.A.forward(self.weights, self.views)[0])

    def start(self, volume: ArrayLike | None) -> mi.Float:
        """The start volume on the device: zero, or `volume` [x, y, z], density per mm.

        Raises
        ------
        InputError
            If it does not fit the geometry or is not finite.
        """
        if volume is None:
            x = dr.zeros(mi.Float, self.A.voxels)
            dr.make_opaque(x)
            return x
        return self._device(volume, 'start volume')

    def _device(self, volume, name: str):
        volume = on_voxels(volume, self.geometry, name)
        return evaluated(mi.Float(volume.ravel()) + scalar(0))  # a copy, because the algorithms write into it

    def residual(self, x: mi.Float) -> tuple[mi.Float, float]:
        """b - A x of all views, and |b - A x| / |b|."""
        r = evaluated(self.b - self.A.forward(x, self.views)[0])
        return r, self.relative(r)

    def relative(self, r: mi.Float) -> float:
        """The norm of a residual over the norm of b.

        Raises
        ------
        InputError
            If it is not finite.
        """
        value = norm(r) / self.size_b
        if not np.isfinite(value):
            raise InputError(DIVERGED)
        return value

    def correct(self, x: mi.Float) -> None:
        """Shift b so that, at x, b - A x equals the residual of the *exact* line integrals of the trilinear interpolant.

        Defect correction (Stetter, Numer. Math. 29, 1978). Joseph's projector has an error of about 0.45 % (docs/benchmarks),
        which causes streaks if an algorithm matches the projections more closely. Costs two projections; does nothing for the
        exact projector.
        """
        if not isinstance(self.A, GridPair):
            joseph, exact = (A.forward(x, self.views)[0] for A in (self.A, GridPair(self.geometry, self.valid)))
            self.b = evaluated(self.measured + (joseph - exact))

    def volume(self, x: mi.Float) -> np.ndarray:
        """A device volume as float32 [x, y, z].

        Raises
        ------
        InputError
            If it is not finite.
        """
        volume = x.numpy().reshape(self.geometry.grid.shape)
        if not np.isfinite(volume).all():
            raise InputError(DIVERGED)
        return volume


def evaluated(x: Any) -> mi.Float:
    """The array, evaluated on the device."""
    dr.eval(x)
    return x


def scalar(x: float) -> mi.Float:
    """An opaque number, for values that change between iterations; a literal would be compiled into the kernel."""
    return dr.opaque(mi.Float, float(x))


def dot(a: mi.Float, b: mi.Float) -> float:
    """Inner product: partial sums of 4096 terms in float32, their sum in float64."""
    return float(dr.block_sum(a * b, min(PARTIAL, dr.width(a))).numpy().sum(dtype=np.float64))


def norm(a: mi.Float) -> float:
    """Square root of the sum of squares."""
    return dot(a, a) ** 0.5


def on_voxels(volume: ArrayLike, geometry: Geometry, name: str) -> np.ndarray:
    """A volume as float32 [x, y, z].

    Raises
    ------
    InputError
        If it does not fit the geometry or is not finite.
    """
    volume = np.ascontiguousarray(as_numpy(volume, f'the {name}', np.float32))
    if volume.shape != geometry.grid.shape:
        raise InputError(f'the {name}: shape {volume.shape}, but the geometry says nVoxel = {geometry.grid.shape}')
    if not np.isfinite(volume).all():
        raise InputError(f'the {name}: NaN or infinity')
    return volume
