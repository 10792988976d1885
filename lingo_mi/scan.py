"""A scan: projections and their geometry. Pure NumPy."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from scipy import ndimage

from lingo_mi.common import notebook
from lingo_mi.common.arrays import as_numpy, short_repr
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.geometry import CurvedGeometry, Geometry, Grid
from lingo_mi.geometry.rays import Index, checked_views

PIECE = 16  # views that are read together in a pass over all views


class PixelEffects(Protocol):
    """Properties of effects that a scan needs. The class `effects.forward.Effects` is in a package above this one."""

    def masked(self, scan: Scan) -> Scan:
        """The scan with dead pixels invalid."""
        ...

    def binned(self, pixels: int) -> Any:
        """The same effects after binning the panel by that many pixels."""
        ...


class StoredViews(ABC):
    """Projections that lie in a file, which is read where they are needed; `files.zarr_views` reads them."""

    shape: tuple[int, int, int]  # of the projections [view, v, u]

    @abstractmethod
    def __getitem__(self, index: Index) -> np.ndarray:
        """Line integrals of some views, float32 [view, v, u], finite."""

    @abstractmethod
    def subset(self, index: Index) -> StoredViews:
        """Some of the views, which are not read."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[:].astype(dtype or np.float32, copy=False)


@dataclass(frozen=True, eq=False)
class Scan:
    """Measured or simulated projections.

    Projections and masks may be arrays of any library that has `__array__` or `__dlpack__`.

    Parameters
    ----------
    geometry : Geometry
        In mm.
    projections : float32 [view, v, u]
        Line integrals ln(I0 / I), density times mm. If they are `StoredViews`, `views` reads only the views that it is asked
        for, and `projections` reads all and keeps them.
    valid : ndarray or None
        Bool [view, v, u], False for pixels to leave out (dead ones, metal, a collimator's shadow); None: all are valid. The
        projections become 0 in pixels that are left out, even if they were NaN.
    effects : PixelEffects or None
        Effects of a detector besides line integrals (`effects.forward.Effects`), or None. With effects, the projections are -ln
        of the detector's signal, and densities are attenuation at the tube's reference energy.

    Raises
    ------
    InputError
        If their shapes are not the geometry's, if a valid pixel is not finite, if no pixel is valid, and for effects on a
        curved panel.

    Examples
    --------
    >>> scan = Scan(Geometry.parallel(nDetector=8, dDetector=1, nVoxel=8, dVoxel=1, angles=[0.0, 1.5]), np.zeros((2, 8, 8)))
    """

    geometry: Geometry
    projections: np.ndarray
    valid: np.ndarray | None = None

    effects: PixelEffects | None = None
    stored: StoredViews | None = field(default=None, init=False)

    if not TYPE_CHECKING:

        def __getattr__(self, name):  # missing attributes: the projections of stored views, before they are read
            if name != 'projections' or self.__dict__.get('stored') is None:
                raise AttributeError(f'{type(self).__name__!r} object has no attribute {name!r}')
            object.__setattr__(self, 'projections', self.stored[:])
            return self.projections

    def __repr__(self) -> str:
        return (
            short_repr(self)
            if self.stored is None
            else f'Scan(geometry={self.geometry!r}, projections={self.stored!r})'
        )

    def _repr_html_(self) -> str:
        """For a notebook: the projections with a slider, and the scanner."""
        return (
            notebook.box(f'Scan of {len(self)} views', self._views('Projections, ln(I0/I)'))
            + self.geometry._repr_html_()
        )

    def _views(self, title: str) -> str:
        labels = [f'view {i}, at {angle:.1f}°' for i, angle in enumerate(np.degrees(self.geometry.angles))]
        return notebook.frames(self.projections, labels, title)

    def __post_init__(self):
        require_type('geometry', self.geometry, Geometry, 'write Scan(geometry, projections)')
        if self.effects is not None and isinstance(self.geometry, CurvedGeometry):
            raise InputError(
                'effects of a detector are modelled on flat panels alone: give line integrals without effects'
            )
        expected = (len(self.geometry), *self.geometry.nDetector)
        projections: Any = self.projections
        if isinstance(projections, StoredViews) and self.valid is None and self.effects is None:
            object.__setattr__(self, 'stored', projections)
            object.__delattr__(self, 'projections')
            p = projections
        else:
            p = as_numpy(projections, 'the projections', np.float32)
        if p.shape != expected:
            raise InputError(
                f'the projections have the shape {p.shape}, but the geometry says [view, v, u] = {expected}'
            )
        if isinstance(p, StoredViews):
            return
        if self.valid is not None:
            valid = as_numpy(self.valid, 'the mask of valid pixels')
            if valid.shape != expected or valid.dtype != bool:
                raise InputError(
                    f'the mask of valid pixels must be true or false and of the shape of the projections, '
                    f'{expected}, not {valid.dtype} of the shape {valid.shape}'
                )
            if not valid.any():
                raise InputError('no pixel of the scan is valid')
            object.__setattr__(self, 'valid', None if valid.all() else valid)
            if self.valid is not None:
                p = np.where(valid, p, np.float32(0))
        require_finite(p)
        object.__setattr__(self, 'projections', p)

    def __len__(self) -> int:
        return len(self.geometry)

    def subset(self, index: Index) -> Scan:
        """The same scan with some of its views.

        Parameters
        ----------
        index : slice or [m]
            The views: a slice, or integers.

        Returns
        -------
        Scan
            With the same valid pixels and effects. Stored views are not read.

        Raises
        ------
        InputError
            For views that the scan does not have.

        Examples
        --------
        >>> every_second = scan.subset(slice(0, None, 2))
        """
        index = checked_views(index, len(self))
        if self.stored is not None:
            return Scan(self.geometry.subset(index), self.stored.subset(index))  # type: ignore[arg-type] - read when needed
        return replace(
            self,
            geometry=self.geometry.subset(index),
            projections=self.projections[index],
            valid=None if self.valid is None else self.valid[index],
        )

    def views(self, index: Index) -> np.ndarray:
        """The projections of some views. If they are stored in a file, only these are read.

        Parameters
        ----------
        index : slice or [m]
            The views: a slice, or integers.

        Returns
        -------
        ndarray
            Float32 [m, v, u].
        """
        return self.projections[index] if self.stored is None else self.stored[index]

    def pieces(self) -> Iterator[np.ndarray]:
        """Iterate over all projections, `PIECE` views at a time.

        Yields
        ------
        ndarray
            Float32 [view, v, u]; the last may have fewer views.
        """
        for first in range(0, len(self), PIECE):
            yield self.views(slice(first, first + PIECE))

    def binned(self, factor: int) -> Scan:
        """The same views with `factor` x `factor` pixels averaged into one. Remaining rows and columns are dropped.

        Parameters
        ----------
        factor : int
            Pixels a side, at least 1. A side of fewer than two new pixels is not binned.

        Returns
        -------
        Scan
            A new pixel is not valid if one of its pixels is dead or not valid.

        Raises
        ------
        InputError
            For a factor below 1.

        Examples
        --------
        >>> small = scan.binned(2)
        """
        geometry, by = self.geometry.binned(factor), self.geometry.bins(factor)
        rows, columns = geometry.nDetector

        def blocks(values):
            return values[:, : rows * by[0], : columns * by[1]].reshape(len(self), rows, by[0], columns, by[1])

        mask = self.valid if self.effects is None else self.effects.masked(self).valid
        p = blocks(self.projections).mean((2, 4))
        valid = None if mask is None else blocks(mask).all((2, 4))
        effects = self.effects and self.effects.binned(by[0] * by[1])
        return replace(self, geometry=geometry, projections=p, valid=valid, effects=effects)

    def on(self, grid: Grid) -> Scan:
        """The same scan with other voxels.

        Parameters
        ----------
        grid : Grid
            The new voxels, mm.

        Returns
        -------
        Scan
            With the same projections.

        Examples
        --------
        >>> fine = scan.on(scan.geometry.grid.finer(2))
        """
        if self.stored is not None:
            return Scan(self.geometry.on(grid), self.stored)  # type: ignore[arg-type] - read when needed
        return replace(self, geometry=self.geometry.on(grid))

    def to_flat(self) -> Scan:
        """Resample the scan on a flat panel, for methods that do not support curved ones.

        Line integrals are interpolated along rows and columns: by cubic splines, or linearly if some pixels are not valid. A
        pixel with such a neighbour is not valid.

        Returns
        -------
        Scan
            On the panel of `CurvedGeometry.to_flat`; a scan with a flat panel is returned unchanged.

        Raises
        ------
        InputError
            As `CurvedGeometry.to_flat`.

        Examples
        --------
        >>> flat = scan.to_flat()
        """
        if not isinstance(self.geometry, CurvedGeometry):
            return self
        flat, (top, bottom, left, right) = self.geometry.to_flat(), self.geometry.flat_pixels()
        real = self.geometry.rays(curved=True)
        x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
        out = np.empty((len(self), *x.shape), np.float32)
        valid = None if self.valid is None else np.empty(out.shape, bool)
        for view, image in enumerate(self.projections):
            column, row = real.on_panel(x, y, view)
            out[view] = interpolated(image, column, row, 3 if valid is None else 1)
            if valid is not None and self.valid is not None:
                valid[view] = interpolated(self.valid[view].astype(float), column, row, 1) > 1 - 1e-6
        return Scan(flat, out, valid)

    def digest(self) -> str:
        """Return a digest of the scan, by which stored work is recognised.

        Returns
        -------
        str
            32 characters, from voxels, rays, projections and valid pixels.
        """
        geometry, rays = self.geometry, self.geometry.rays(curved=True)
        numbers = geometry.grid.shape, geometry.grid.spacing, geometry.grid.centre, geometry.nDetector
        hasher = hashlib.blake2b(repr(numbers).encode(), digest_size=16)
        bend = None if rays.curve is None else rays.curve.numbers
        for array in (rays.source, rays.corner, rays.u, rays.v, bend, *self.pieces(), self.valid):
            hasher.update(b'' if array is None else np.ascontiguousarray(array).data)
        return hasher.hexdigest()

    @property
    def normalised(self) -> np.ndarray:
        """Line integrals in the normalised frame, float32 [view, v, u]."""
        return self.projections * np.float32(self.geometry.grid.scale)


def interpolated(image: np.ndarray, x: np.ndarray, y: np.ndarray, order: int = 3) -> np.ndarray:
    """An image [v, u] at pixel positions x, y, pixel centres at i + 1/2, by splines; edge values are held."""
    return ndimage.map_coordinates(image, [y - 0.5, x - 0.5], order=order, mode='nearest')


def require_finite(projections: np.ndarray) -> None:
    """Raises InputError, which names the view, for projections [view, v, u] that are not finite."""
    if not np.isfinite(projections).all():
        view = int(np.argwhere(~np.isfinite(projections))[0, 0])
        raise InputError(
            f'the projections contain NaN or infinity (first in view {view}): repair those pixels, or leave them out '
            'with lm.Scan(geometry, projections, valid=mask), where mask is numpy.isfinite(projections)'
        )


def values_digest(volume: np.ndarray) -> str:
    """Tells volumes apart: 32 characters of their values."""
    return hashlib.blake2b(np.ascontiguousarray(volume, np.float32).data, digest_size=16).hexdigest()


@dataclass(frozen=True, eq=False)
class Dataset:
    """Content of a scan's file: views to fit, views held out, and the true volume [x, y, z], densities in 1/mm.

    The volume may be an array of any library that has `__array__` or `__dlpack__`. Anything else raises InputError.

    Examples
    --------
    >>> Dataset(train=scan.subset(slice(0, None, 2)), test=scan.subset(slice(1, None, 2)))
    """

    train: Scan
    test: Scan | None = None
    volume: np.ndarray | None = None

    __repr__ = short_repr

    def __post_init__(self):
        require_type('train', self.train, Scan, 'write Dataset(Scan(geometry, projections))')
        if self.test is not None:
            require_type('test', self.test, Scan)
        if self.volume is not None:
            object.__setattr__(self, 'volume', as_numpy(self.volume, 'the volume'))

    def _repr_html_(self) -> str:
        """For a notebook: views to fit and held out, the true volume, the scanner."""
        geometry = self.train.geometry
        parts = [self.train._views(f'To fit: {len(self.train)} views')]
        if self.test is not None and len(self.test):
            parts.append(self.test._views(f'Held out: {len(self.test)} views'))
        if self.volume is not None and self.volume.ndim == 3:
            parts.append('<br>' + notebook.slices(self.volume, geometry.grid.spacing, geometry.grid.centre))
        return notebook.box('Dataset', *parts) + geometry._repr_html_()
