"""The rays of views: pure NumPy, no Mitsuba.

`Rays` is what every projector knows of a scan: nothing in it says that a source moves on a circle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry.curve import Curve
from lingo_mi.geometry.limits import LEAST_LENGTH, MOST_LENGTH, numbers

Index: TypeAlias = slice | np.ndarray | list[int]  # of some views: integers [m]


def checked_views(index: Index, count: int) -> Index:
    """`index` of some of `count` views.

    Raises
    ------
    InputError
        If it is neither a slice nor integers, or beyond the views.
    """
    if isinstance(index, slice):
        return index
    try:
        views = np.asarray(index)
    except (TypeError, ValueError, OverflowError):  # lists of several lengths
        views = np.empty((0, 0))
    whole = views.dtype.kind in 'iu' and (views.size == 0 or -count <= views.min() and views.max() < count)
    mask = views.dtype.kind == 'b' and views.shape == (count,)
    if views.ndim != 1 or not (whole or mask or views.size == 0):
        raise InputError(
            f'views are chosen by a slice or a list of numbers from 0 to {count - 1}, not by {shown(index)}'
        )
    return views if views.size else views.astype(int)


@dataclass(frozen=True, eq=False)
class Rays:
    """The rays of n views.

    The ray through the continuous pixel position (x, y), pixel centres at (i + 1/2, j + 1/2), is

    - `cone`: from `source` along  corner + x u + y v - source
    - `parallel`: from  corner + x u + y v  along `source`, which then holds the unit beam direction

    With a `curve`, these are the flat panels that the curved ones touch, and x, y the position `curve.on_plane` of a pixel.

    Parameters
    ----------
    source, corner, u, v : float64 [n, 3]
        Corner is the outer corner of pixel (0, 0), u and v are one pixel long steps.
    curve : Curve or None
        How the panels are bent; None: they are flat.

    Examples
    --------
    >>> rays = Rays(source, corner, u, v, parallel=False).checked()
    >>> x, y = rays.project(points, 0)
    """

    source: np.ndarray
    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray
    parallel: bool
    curve: Curve | None = None

    @classmethod
    def from_vectors(cls, vectors: ArrayLike, parallel: bool) -> Rays:
        """The views whose `vectors` these are, [n, 4, 3], checked: see `checked`."""
        array = numbers('the vectors of the poses', vectors)
        if array.ndim != 3 or array.shape[1:] != (4, 3):
            raise InputError(
                f'the vectors of the poses are source, corner, u and v of each view, [view, 4, 3], not {list(array.shape)}'
            )
        return Rays(*array.transpose(1, 0, 2), parallel=parallel).checked()

    @property
    def vectors(self) -> np.ndarray:
        """source, corner, u and v of each view as one array, float64 [n, 4, 3]."""
        return np.stack(self._arrays(), 1)

    def by_motion(self, by_vectors: ArrayLike) -> np.ndarray:
        """Derivatives by a rigid motion of each view, [n, 6], from the derivatives of a number by `vectors`, [n, 4, 3].

        The first three are by a turn about the origin, a rotation vector in radians, and the others by a shift. Sum over the
        views if they all move together.

        Examples
        --------
        >>> turn, shift = rays.by_motion(gradient).sum(0).reshape(2, 3)
        """
        gradient = np.asarray(by_vectors, float)
        turn = np.cross(self.vectors, gradient).sum(1)
        shift = gradient[:, 1] if self.parallel else gradient[:, 1] + gradient[:, 0]
        return np.concatenate([turn, shift], 1)

    def __len__(self) -> int:
        return len(self.corner)

    def __getitem__(self, index: Index) -> Rays:
        """The views selected by a slice or an integer array; one view stays [1, 3] when given as a list."""
        curve = self.curve and self.curve[index]
        return Rays(self.source[index], self.corner[index], self.u[index], self.v[index], self.parallel, curve)

    def centre(self, nDetector: tuple[int, int]) -> np.ndarray:
        """The panels' centres [n, 3]; nDetector is (v, u) pixels."""
        return self.corner + nDetector[1] / 2 * self.u + nDetector[0] / 2 * self.v

    def moved(self, rotation: ArrayLike | None = None, shift: ArrayLike | None = None) -> Rays:
        """The views turned about the origin, then shifted: rotation [3, 3] or [n, 3, 3], shift [3] or [n, 3]."""
        rotation = np.eye(3) if rotation is None else np.asarray(rotation, float)
        shift = np.zeros(3) if shift is None else np.asarray(shift, float)
        source, corner, u, v = ((rotation @ x[..., None])[..., 0] for x in (self.source, self.corner, self.u, self.v))
        source = source if self.parallel else source + shift
        return replace(self, source=source, corner=corner + shift, u=u, v=v)

    def cropped(self, x: float, y: float) -> Rays:
        """The part of the panels that begins at the pixel position x, y."""
        return replace(
            self, corner=self.corner + x * self.u + y * self.v, curve=self.curve and self.curve.cropped(x, y)
        )

    def joined(self, other: Rays) -> Rays:
        """These views, then the other's, of the same kind of beam."""
        if self.parallel != other.parallel:
            raise InputError('views of a parallel and of a cone beam cannot be one scan')
        if self.curve is not None or other.curve is not None:
            raise InputError('views of curved panels are joined as geometries: see CurvedGeometry.joined')
        pairs = zip(self._arrays(), other._arrays())
        return Rays(*(np.concatenate(pair) for pair in pairs), parallel=self.parallel)

    def checked(self) -> Rays:
        """These views as float64 arrays, parallel beams of unit length.

        Raises
        ------
        InputError
            Naming the first bad view, if an array is not [n, 3] or not finite, if u and v span no panel, or if the rays
            run along it.
        """
        source, corner, u, v = (numbers(name, a) for name, a in zip(('source', 'corner', 'u', 'v'), self._arrays()))
        if any(a.ndim != 2 or a.shape[1] != 3 or len(a) != len(corner) for a in (source, corner, u, v)) or not len(
            corner
        ):
            raise InputError(
                'source, corner, u and v of the poses must all be [view, 3], of at least one view, not '
                + ', '.join(str(list(a.shape)) for a in (source, corner, u, v))
            )
        for what, bad in _faults(source, corner, u, v, self.parallel):
            if bad.any():
                raise InputError(f'the pose of view {int(np.argmax(bad))} {what}')
        if self.parallel:
            source = source / np.linalg.norm(source, axis=1, keepdims=True)
        return Rays(source, corner, u, v, bool(self.parallel))

    def through(self, view: int, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Origins and (unnormalised) directions [..., 3] of the rays of one view at pixel positions x, y."""
        if self.curve is not None:
            x, y = self.curve.on_plane(x, y, view)
        x, y = np.asarray(x, float)[..., None], np.asarray(y, float)[..., None]
        point = self.corner[view] + x * self.u[view] + y * self.v[view]
        if self.parallel:
            return point, np.broadcast_to(self.source[view], point.shape)
        return np.broadcast_to(self.source[view], point.shape), point - self.source[view]

    def project(self, points: ArrayLike, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Continuous pixel positions (x, y) of `points` [N, 3], NaN if a point is not in front of the source.

        NaN also if the ray through a point misses a curved panel's cylinder.
        """
        points = np.asarray(points, float)
        a, b, c = self.u[view], self.v[view], self.corner[view]
        d = np.broadcast_to(self.source[view], points.shape) if self.parallel else points - self.source[view]
        start = points if self.parallel else self.source[view]
        # Solve  start + t d = c + x a + y b  by Cramer's rule.
        n = np.cross(a, b)
        along = d @ n
        with np.errstate(divide='ignore', invalid='ignore'):
            t = (c - start) @ n / along
            hit = start + t[:, None] * d - c
        if not self.parallel:
            hit[~(t > 0)] = np.nan
        nn = n @ n
        return self.on_panel(np.cross(hit, b) @ n / nn, np.cross(a, hit) @ n / nn, view)

    def on_panel(self, x: ArrayLike, y: ArrayLike, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Pixel positions of the rays through positions x, y of the flat panel: those positions, unless there is a `curve`."""
        x, y = np.asarray(x, float), np.asarray(y, float)
        return (x, y) if self.curve is None else self.curve.on_panel(x, y, view)

    def points(self, view: int, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the positions in space [..., 3] of the positions x, y on a view's panel."""
        start, direction = self.through(view, x, y)
        if self.parallel:
            return start
        return start + direction * (1 if self.curve is None else self.curve.share(x, view)[..., None])

    def outline(self, view: int, nDetector: tuple[int, int]) -> np.ndarray:
        """The edge of a view's panel, [m, 3]: its corners, from corner along the first row; of a curved one, 16 points a side."""
        rows, columns = nDetector
        x = np.linspace(0, columns, 2 if self.curve is None else 16)
        return np.concatenate([self.points(view, x, 0 * x), self.points(view, x[::-1], 0 * x + rows)])

    def _arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self.source, self.corner, self.u, self.v


def _faults(source, corner, u, v, parallel) -> Iterator[tuple[str, Any]]:
    """Return the possible faults of poses, each with the views [n] that have it. Later faults assume that earlier ones are
    absent."""
    far = ~(np.abs(np.concatenate([source, corner, u, v], 1)) <= MOST_LENGTH).all(1)
    yield f'holds NaN or infinity, or numbers beyond {MOST_LENGTH:.0e}', far
    normal = np.cross(u, v)
    area = np.linalg.norm(normal, axis=1)
    along_u, along_v = np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)
    yield f'has steps u and v shorter than {LEAST_LENGTH:.0e}', ~(np.minimum(along_u, along_v) >= LEAST_LENGTH)
    steps = along_u * along_v
    yield 'has steps u and v that span no panel', ~(area > 1e-9 * steps)
    beam = source if parallel else corner - source
    length = np.linalg.norm(beam, axis=1)
    if parallel:
        yield 'has a beam without a direction', ~(length > 0)
    along = np.abs(np.sum(beam * normal, 1))
    yield (
        'has a beam along its panel' if parallel else 'has its source in the plane of its panel',
        ~(along > 1e-9 * np.maximum(length, np.sqrt(steps)) * area),
    )
