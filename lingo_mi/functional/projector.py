"""The projector of voxels as a linear map, A and its transpose."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError, require_type, shown
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.functional.frameworks import Argument, call
from lingo_mi.functional.linear_map import LinearMap
from lingo_mi.functional.rays import beams_of, on_host, rays_argument
from lingo_mi.geometry import Geometry, PosedGeometry
from lingo_mi.geometry.rays import Index, checked_views
from lingo_mi.projectors.fastest import projector_class
from lingo_mi.projectors.grid_pair import GridPair
from lingo_mi.projectors.ray_gradient import moving
from lingo_mi.projectors.stack import Block
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.usable import require_unfrozen

MODELS = 'joseph', 'exact'


class Projector(LinearMap):
    """A: line integrals of a voxel volume in the views of a scan. A.T: backprojection, the transpose of A.

    `A(volume)` takes densities [x, y, z], per mm, and returns line integrals [view, v, u] without a unit. `A.T(projections)`
    returns a number for each voxel: the sum of all pixels' values, each times the voxel's weight in that line integral, in mm.
    A.T is the transpose of A to rounding. Both take and return arrays of NumPy, Dr.Jit, PyTorch or JAX, with leading batch axes,
    and are differentiable in them. Computation is in float32.

    `A(volume, rays=rays)` takes the rays from an array, and is differentiable in it (`__call__`).

    Parameters
    ----------
    geometry : Geometry
        The scanner and the grid of the volume.
    model : {'joseph', 'exact'}
        'joseph' samples each ray once a slice of voxels, and interpolates there (error about 0.5 % of the line integrals).
        'exact' integrates the trilinear interpolant exactly, and takes 2 to 8 times as long. Unless the whole
        volume lies in front of the source, the model is always 'exact'.
    views : slice or sequence of int, optional
        Views of the geometry (default: all).
    valid : array of bool, optional
        Pixels to use, [view, v, u] or [v, u]. Others are zero in the projections and add nothing to the transpose, even if they
        are NaN.

    Attributes
    ----------
    geometry : Geometry
        The geometry of the chosen views.
    model : str
        The model that is used.
    domain_shape, range_shape : tuple of int
        (x, y, z) and (view, v, u).

    Raises
    ------
    InputError
        For another type, an unknown model, views that the geometry does not have, and a mask of another shape.

    References
    ----------
    Joseph, "An improved algorithm for reprojecting rays through pixel images", IEEE TMI 1 (1982). The transpose is matched: a
    voxel gathers from the pixels whose rays meet it, with the same weights.

    Examples
    --------
    SIRT in eight lines:

    >>> import numpy as np, lingo_mi as lm
    >>> panel, voxels = dict(nDetector=(8, 24), dDetector=1), dict(nVoxel=(16, 16, 8), dVoxel=1)
    >>> A = lm.Projector(lm.Geometry.parallel(**panel, **voxels, angles=lm.circular(12)))
    >>> b = A(np.ones(A.domain_shape))
    >>> rows, columns = A(np.ones(A.domain_shape)), A.T(np.ones(A.range_shape))
    >>> x = np.zeros(A.domain_shape, np.float32)
    >>> for _ in range(20):
    ...     x += A.T((b - A(x)) / np.maximum(rows, 1e-6)) / np.maximum(columns, 1e-6)
    >>> bool(np.linalg.norm(A(x) - b) < 0.01 * np.linalg.norm(b))
    True
    """

    def __init__(
        self, geometry: Geometry, *, model: str = 'joseph', views: Index | None = None, valid: ArrayLike | None = None
    ):
        require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
        if model not in MODELS:
            raise InputError(f'model is {" or ".join(map(repr, MODELS))}, not {shown(model)}')
        mask = None if valid is None else _mask(valid, (len(geometry), *geometry.nDetector))
        if views is not None:
            if not np.arange(len(geometry))[checked_views(views, len(geometry))].size:
                raise InputError('the projector has no views: choose at least one')
            geometry, mask = geometry.subset(views), None if mask is None else mask[views]
        self.geometry = geometry
        self.valid = None if mask is None else np.array(mask, order='C')  # the caller may change theirs
        self._kind = GridPair if model == 'exact' else projector_class(geometry)
        self.model = 'exact' if self._kind is GridPair else 'joseph'
        self.domain_shape, self.range_shape = geometry.grid.shape, (len(geometry), *geometry.nDetector)
        self._built: dict[str, tuple[Any, Block]] = {}  # by Mitsuba's variant
        self._single: dict[int, Projector] = {}  # by view

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), '_single': {}}  # a copy makes its own

    @cached_property
    def T(self) -> Backprojector:
        """The transpose: projections [..., view, v, u] to a volume [..., x, y, z]."""
        return Backprojector(self)

    def __getitem__(self, views: int | Index) -> Projector:
        """The projector of some of the views; one view keeps its axis."""
        if isinstance(views, bool):  # which Python takes for 0 or 1
            raise InputError(f'a view is chosen by its number, not by {views}')
        if not isinstance(views, int | np.integer):
            return Projector(self.geometry, model=self.model, views=views, valid=self.valid)
        view = int(views)
        if view not in self._single:  # Kaczmarz' method takes them again in each sweep
            self._single[view] = Projector(self.geometry, model=self.model, views=[view], valid=self.valid)
        return self._single[view]

    def __len__(self) -> int:
        return len(self.geometry)

    def __iter__(self) -> Iterator[Projector]:
        """The projectors of single views."""
        return (self[i] for i in range(len(self)))

    def __repr__(self) -> str:
        return f'Projector({self.model}, {_by(self.domain_shape)} voxels to {_by(self.range_shape)} pixels)'

    def __call__(self, x: Any, *, rays: Any = None) -> Any:
        """Projections of a volume [..., x, y, z]: float32 [..., view, v, u], of the caller's kind, on its device.

        Parameters
        ----------
        x : array
            The volume. It may be differentiated any number of times, in reverse and in forward mode (with Dr.Jit's arrays once).
        rays : array, optional
            Rays to use instead of `A.geometry.rays().vectors`, [view, 4, 3], mm, of the volume's library: for each view the
            source (in a parallel beam its direction), the corner of the panel, and the steps u and v from pixel to pixel. Rays of
            float64 are used in float64. The volume then has no batch axes, and both arrays are differentiable once, in reverse
            mode, and with Dr.Jit also in forward mode.

        Returns
        -------
        array
            The projections. With rays, they are the projections of a scan with these poses.

        Raises
        ------
        InputError
            For an array of another shape or kind, or with NaN or infinity, for rays that make no view, and if the result does
            not fit into memory.

        Notes
        -----
        Derivatives with respect to the rays are exact for the model. At kinks of its interpolation they are the mean of both
        sides. They do not contain the jumps of Joseph's model. This model jumps if a sample enters the box and the volume is
        not zero at its faces, if the main axis of a ray changes, and, for a ray of a cone that is steeper than 45 degrees in
        voxels, if the panel begins to lean. If these jumps matter, use `model='exact'`, which has none.

        Examples
        --------
        The derivatives of a loss with respect to source, corner, u and v of each view, in PyTorch: ::

            rays = torch.tensor(geometry.rays().vectors, requires_grad=True)
            loss = (A(volume, rays=rays) - measured).square().sum()
            loss.backward()                              # rays.grad [view, 4, 3]
        """
        if rays is None:
            return super().__call__(x)
        volume = Argument('the volume', x, self.domain_shape)
        return call(self._with_rays, [volume, rays_argument(rays, len(self))], self.range_shape, repr(self))

    def _with_rays(self, volume: Any, vectors: Any) -> Any:
        """Projections of a tensor [x, y, z] along the rays of a tensor [view, 4, 3], Float [view * v * u]."""
        require_unfrozen(repr(self))
        poses = on_host(vectors, self.geometry)
        geometry = PosedGeometry(poses=poses, nDetector=self.geometry.nDetector, grid=self.geometry.grid)
        there = Projector(geometry, model=self.model, valid=self.valid)
        volume = mi.Float(volume.array)
        images = there(volume)
        if not dr.grad_enabled(vectors):
            return images
        views = [moving(volume, geometry, there._kind, view) for view in beams_of(vectors, geometry)]
        moved = dr.gather(
            mi.Float, dr.concat(views), _transposed(geometry.nDetector, len(self)), mode=dr.ReduceMode.Permute
        )
        change = moved - dr.detach(moved)
        return images + (change if self.valid is None else change * uploaded(self.valid))

    def on_device(self, x: Any) -> Any:
        pair, block = self._pair()
        integrals, _ = pair.forward(x, block)
        out = dr.empty(mi.Float, math.prod(self.range_shape))
        dr.scatter(out, integrals, _transposed(pair.panel[::-1], len(self)), mode=dr.ReduceMode.Permute)
        dr.eval(out)
        return out

    def backproject(self, y: Any) -> Any:
        """Apply the transpose to evaluated pixels on the device: `A.T.on_device`.

        Parameters
        ----------
        y : mi.Float
            Pixels of all images, flat.

        Returns
        -------
        mi.Float
            Voxels, flat.
        """
        pair, block = self._pair()
        out = pair.adjoint(dr.gather(mi.Float, y, _transposed(pair.panel[::-1], len(self))), block)
        dr.eval(out)
        return out

    def _pair(self) -> tuple[Any, Block]:
        """The projector of the active variant, and all views."""
        variant = mi.variant() or ensure_variant()
        if variant not in self._built:
            self._built[variant] = self._kind(self.geometry, self.valid), Block.of(range(len(self)))
        return self._built[variant]


class Backprojector(LinearMap):
    """The transpose of a `Projector`.

    Attributes
    ----------
    T : Projector
        The operator whose transpose this is.
    """

    def __init__(self, projector: Projector):
        self._projector = projector
        self.domain_shape, self.range_shape = projector.range_shape, projector.domain_shape
        self.counted = True if projector.valid is None else projector.valid

    @property
    def T(self) -> Projector:
        return self._projector

    def on_device(self, x: Any) -> Any:
        return self._projector.backproject(x)

    def __repr__(self) -> str:
        return f'{self._projector!r}.T'


def _transposed(shape: tuple[int, int], views: int) -> Any:
    """Return the indices of the pixels of `views` images of a shape (slow, fast) in images of the other order."""
    slow, fast = shape
    index = dr.arange(mi.UInt, views * slow * fast)
    line = index // fast
    view = line // slow
    return (view * fast + index - line * fast) * slow + line - view * slow


def _mask(valid: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    mask = as_numpy(valid, 'valid')
    if mask.dtype != bool or mask.shape not in (shape, shape[1:]):
        raise InputError(
            f'valid must be true or false for each pixel, {_by(shape)} or {_by(shape[1:])}, not {mask.dtype}, {_by(mask.shape)}'
        )
    return np.broadcast_to(mask, shape)


def _by(shape: tuple[int, ...]) -> str:
    return ' x '.join(map(str, shape))
