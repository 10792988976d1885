"""Filtered backprojection: FDK for cone and fan beams, FBP for parallel beams (NumPy and Dr.Jit).

Feldkamp, Davis, Kress, "Practical cone-beam algorithm", JOSA A 1 (1984). With tau the pixel size at the axis,
w the distance of a voxel from the source along the central ray over DSO, and h the band-limited ramp of Kak
and Slaney ("Principles of Computerized Tomographic Imaging", 1988, section 3.3),

    f(x) = sum over views  dbeta / w^2  tau (h * [cosine p])(u(x), v(x))

where the view weights dbeta sum to pi (`view_weights`). A parallel beam has w = 1 and no cosine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from math import prod
from pathlib import Path
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft
from numpy.lib.format import open_memmap
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, require_type
from lingo_mi.geometry import CircularGeometry, Geometry
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.arcs import gaps
from lingo_mi.reconstruction.fill import filled as with_every_pixel
from lingo_mi.reconstruction.preconditions import require_circle
from lingo_mi.reconstruction.rectify import rectified, rectified_geometry
from lingo_mi.scan import Scan
from lingo_mi.scene.checks import check_memory

fft: Any = scipy.fft  # untyped: its functions look like those that dispatch them

# Apodisation of the ramp over |frequency| in units of the Nyquist frequency, f in [0, 1].
WINDOWS = {
    'ram-lak': lambda f: np.ones_like(f),
    'shepp-logan': lambda f: np.sinc(f / 2),
    'cosine': lambda f: np.cos(np.pi / 2 * f),
    'hamming': lambda f: 0.54 + 0.46 * np.cos(np.pi * f),
    'hann': lambda f: 0.5 + 0.5 * np.cos(np.pi * f),
}

NAME = 'filtered backprojection'  # in messages
SAME_ANGLE = 1e-6  # radians
BATCH = 4  # views per launch, which share the index arithmetic and the volume's memory traffic


def window_of(filter: str) -> Callable[[np.ndarray], np.ndarray]:
    """One of `WINDOWS`, by its name or TIGRE's (with _ in place of -).

    Raises
    ------
    InputError
        For an unknown one.
    """
    shape = WINDOWS.get(filter.replace('_', '-')) if isinstance(filter, str) else None
    if shape is None:
        raise InputError(f'filter {filter!r} is unknown: use one of {", ".join(WINDOWS)}')
    return shape


def ramp(n: int, tau: float, window: str = 'ram-lak') -> np.ndarray:
    """Frequency response [size // 2 + 1] of the ramp for n pixels of size tau, zero-padded to twice as many.

    It is the transform of the sampled band-limited kernel h(0) = 1 / (4 tau^2), h(odd k) = -1 / (pi k tau)^2,
    times tau. Unlike a ramp sampled in frequency, it gives the right mean.

    Raises
    ------
    InputError
        For an unknown window.
    """
    shape = window_of(window)
    size = fft.next_fast_len(2 * n, real=True)
    k = np.minimum(np.arange(size), size - np.arange(size))
    kernel = np.where(k % 2 == 1, -1 / (np.pi * np.maximum(k, 1) * tau) ** 2, 0.0)
    kernel[0] = 1 / (4 * tau**2)
    response = tau * fft.rfft(kernel).real
    return response * shape(np.linspace(0, 1, len(response)))


def view_weights(geometry: Geometry) -> np.ndarray:
    """The angle that each view represents, [view] radians: half of both gaps to its neighbours on the circle.

    Repeated views share their angle. On a closed circle, a cone beam measures every ray twice, so weights are halved and
    sum to pi, as for half a turn. The weights of an open arc above half a turn are scaled to sum to pi; `ray_weights` then
    separates rays that were measured twice from those measured once. An arc below half a turn keeps its own angle (a
    limited-angle scan lacks density).
    """
    n = len(geometry)
    if n == 1:
        return np.array([np.pi])
    turn = np.pi if geometry.mode == 'parallel' else 2 * np.pi  # after which a parallel beam repeats
    steps = np.round(np.mod(geometry.angles, turn) / SAME_ANGLE) % round(turn / SAME_ANGLE)
    _, first, repeats, counts = np.unique(steps, return_index=True, return_inverse=True, return_counts=True)
    if len(first) == 1:
        return np.full(n, np.pi / n)
    order, gap, _ = gaps(geometry.angles[first], turn)
    weight = np.empty(len(first))
    weight[order] = (gap + np.roll(gap, 1)) / 2
    return (weight / counts)[repeats] * min(1.0, np.pi / gap.sum())


def ray_weights(geometry: CircularGeometry) -> np.ndarray:
    """Weight of every ray among its repetitions, times their usual number: [view, u], or [1, u] if all views agree.

    short scan         a cone beam over an open arc that exceeds half a turn by at least the fan angle: Parker, "Optimal
                       short scan convolution reconstruction for fanbeam CT", Med. Phys. 9 (1982), with the excess in
                       place of the fan angle (Silver, Med. Phys. 27, 2000)
    offset detector    a closed circle and a panel that reaches farther on one side: Wang, "X-ray micro-CT with a displaced
                       detector array", Med. Phys. 29 (2002); the columns must then be `extended`
    otherwise 1        also for an arc that exceeds half a turn by less than the fan angle
    """
    n_u, d_u, offset = geometry.nDetector[1], geometry.dDetector[1], geometry.offDetector[1]
    u = (np.arange(n_u) - (n_u - 1) / 2) * d_u + offset
    cone = geometry.mode == 'cone'
    fan = np.arctan(u / geometry.DSD) if cone else u
    if _lacking(geometry):
        edge = n_u / 2 * d_u - abs(offset)
        if edge <= 0:  # the axis is outside the panel: no ray is measured twice
            return np.full((1, n_u), 2.0)
        overlap = np.arctan(edge / geometry.DSD) if cone else edge
        return 1 + np.sin(np.pi / 2 * np.clip(np.sign(offset) * fan / overlap, -1, 1))[None]
    if not cone or len(geometry) == 1:
        return np.ones((1, n_u))
    order, gap, is_open = gaps(geometry.angles, 2 * np.pi)
    excess = (gap.sum() - np.pi) / 2
    if not is_open or excess <= np.abs(fan).max():
        return np.ones((1, n_u))
    beta = np.empty((len(geometry), 1))
    beta[order, 0] = np.cumsum(gap) - gap / 2
    # The same line is seen from beta + pi - 2 fan.
    rise, fall = beta / (excess + fan), (np.pi + 2 * excess - beta) / (excess - fan)
    return np.sin(np.pi / 4 * np.clip(np.minimum(rise, fall), 0, 2)) ** 2 * gap.sum() / np.pi


def _lacking(geometry: CircularGeometry) -> int:
    """Columns missing on a panel's shorter side. Only on a closed circle, where opposite views measure those rays."""
    if len(geometry) == 1 or gaps(geometry.angles, 2 * np.pi)[2]:
        return 0
    return round(2 * abs(geometry.offDetector[1]) / geometry.dDetector[1])


def extended(geometry: CircularGeometry) -> tuple[CircularGeometry, tuple[int, int]]:
    """A geometry whose panel is symmetric, and the columns to add on either side of the real one: on a closed circle, on the
    shorter side. Filtering spreads measured values into these columns. Any other geometry is returned unchanged.
    """
    lacking = _lacking(geometry)
    if lacking == 0:
        return geometry, (0, 0)
    (n_v, n_u), (off_v, off_u), side = geometry.nDetector, geometry.offDetector, np.sign(geometry.offDetector[1])
    wider = replace(
        geometry,
        nDetector=(n_v, n_u + lacking),
        offDetector=(off_v, off_u - side * lacking * geometry.dDetector[1] / 2),
    )
    return wider, (lacking, 0) if side > 0 else (0, lacking)


def filtered(projections: np.ndarray, geometry: CircularGeometry, window: str = 'ram-lak') -> np.ndarray:
    """Cosine-weighted, ramp-filtered projections, float32 [view, v, u], per mm."""
    n_v, n_u = geometry.nDetector
    tau = geometry.dDetector[1]
    if geometry.mode == 'cone':
        u = (np.arange(n_u) - (n_u - 1) / 2) * geometry.dDetector[1] + geometry.offDetector[1]
        v = (np.arange(n_v) - (n_v - 1) / 2) * geometry.dDetector[0] - geometry.offDetector[0]
        cosine = geometry.DSD / np.sqrt(geometry.DSD**2 + u**2 + v[:, None] ** 2)
        projections = projections * cosine.astype(np.float32)
        tau *= geometry.DSO / geometry.DSD
    response = ramp(n_u, tau, window).astype(np.float32)
    size = fft.next_fast_len(2 * n_u, real=True)
    return fft.irfft(fft.rfft(projections, size, workers=-1) * response, size, workers=-1)[..., :n_u]


def _add_views(volume, views, geometry):
    """Add views, each (image, matrix, weight), to the volume: bilinear, zero outside the panel."""
    (n_v, n_u), (_, ny, nz) = geometry.nDetector, geometry.grid.shape
    index = dr.arange(mi.UInt, int(np.prod(geometry.grid.shape)))
    row = index // nz
    i = row // ny
    voxel = mi.Vector3f(mi.Float(i), mi.Float(row - i * ny), mi.Float(index - row * nz))
    for image, matrix, weight in views:
        x, y, w = (dr.fma(m[0], voxel.x, dr.fma(m[1], voxel.y, dr.fma(m[2], voxel.z, m[3]))) for m in matrix)
        inv = dr.rcp(w)
        x, y = dr.fma(x, inv, -0.5), dr.fma(y, inv, -0.5)
        # The panel ends half a pixel outside the outermost pixel centres.
        seen = (w > 0) & (x > -0.5) & (x < n_u - 0.5) & (y > -0.5) & (y < n_v - 0.5)
        x, y = dr.clip(x, 0, n_u - 1), dr.clip(y, 0, n_v - 1)
        x0, y0 = mi.UInt(x), mi.UInt(y)
        x1, y1 = dr.minimum(x0 + 1, n_u - 1), dr.minimum(y0 + 1, n_v - 1)
        # The image is stored v fastest, like the volume's z.
        p = [dr.gather(mi.Float, image, column * n_v + line, seen) for column in (x0, x1) for line in (y0, y1)]
        fy = y - mi.Float(y0)
        value = dr.lerp(dr.lerp(p[0], p[1], fy), dr.lerp(p[2], p[3], fy), x - mi.Float(x0))
        volume = dr.fma(dr.select(seen, weight * inv * inv, 0), value, volume)
    return volume


@dataclass(frozen=True)
class FDK(Algorithm):
    """Filtered backprojection: FDK for cone beams, its fan-beam form for one detector row, FBP for parallel beams.

    Each view is weighted by the cosine of its rays, convolved along its rows with the band-limited ramp h, and backprojected,

        f(x) = sum over views  dbeta / w^2  tau (h * [cosine p])(u(x), v(x))

    with the pixel size tau at the axis and the distance w of x from the source along the central ray, over DSO.

    Short scans get Parker's weights, and offset panels Wang's (`ray_weights`). Projections of a turned or tilted panel are
    first resampled to an upright one (`rectified`). The views together must cover the whole width of the object, because
    truncated rows are not extrapolated. A view adds nothing to voxels outside its panel. With one detector row, only the slice
    in the plane of the fan is meaningful.

    Use it for hundreds of views, or if time is short. Few views cause streaks, and the ramp amplifies noise.

    Feldkamp, Davis and Kress, "Practical cone-beam algorithm", JOSA A 1 (1984), with the ramp of Kak and Slaney, "Principles of
    Computerized Tomographic Imaging", 1988, section 3.3.

    Parameters
    ----------
    filter : str
        Apodisation of the ramp: 'ram-lak' (none), 'shepp-logan', 'cosine', 'hamming' or 'hann', from sharp to smooth. TIGRE's
        names 'ram_lak' and 'shepp_logan' are accepted, too.
    fill : bool
        Whether invalid pixels are interpolated along their rows and over views, with a warning. If not, a scan with invalid
        pixels is refused.

    Raises
    ------
    InputError
        For an unknown filter.

    Examples
    --------
    >>> import lingo_mi as lm
    >>> from lingo_mi.phantoms import make, x3d_scan
    >>> measured = x3d_scan.scan(make('foot', 24), views=90, pixels=48).train
    >>> lm.reconstruct(measured, lm.FDK(filter='hann'), progress=False).volume.shape
    (24, 24, 24)
    """

    name: ClassVar[str] = 'fdk'
    no_start: ClassVar[str] = (
        'filtered backprojection starts from no volume: leave out start, or take another algorithm'
    )

    filter: str = 'ram-lak'
    fill: bool = True

    def __post_init__(self):
        window_of(self.filter)
        require_type('fill', self.fill, bool)

    def steps(self, scan: Scan) -> int:
        return len(scan)

    def _run(self, scan: Scan, *, start: ArrayLike | None = None, progress: Progress | None = None) -> Reconstruction:
        """Reconstruct the volume of a scan, see `run_algorithm`. `progress` counts views; there are no residuals.

        Raises
        ------
        InputError
            For a source that is not on a circle about z, for a panel that moves relative to the source, and for invalid pixels
            without `fill`.
        """
        began = time.perf_counter()
        images, geometry = self.images(scan)
        volume = backprojected(geometry, images, progress)
        return Reconstruction(volume, [], time.perf_counter() - began, scan.geometry.grid)

    def images(self, scan: Scan) -> tuple[Callable[[int], np.ndarray], CircularGeometry]:
        """A function that weights and filters `BATCH` views from its argument on, float32 [view, u, v], and their geometry."""
        projections, geometry = _weighted(with_every_pixel(scan) if self.fill else scan)

        def images(first):
            return filtered(projections(first), geometry, self.filter).transpose(0, 2, 1)

        return images, geometry

    def slabs(self, scan: Scan, thickness: int, *, progress: Progress | None = None) -> Iterator[np.ndarray]:
        """Reconstruct the volume in slabs along z.

        It takes memory for two sets of projections and for three slabs, however large the volume. Stored views are read again for
        every slab, and take no memory for sets of them.

        Parameters
        ----------
        scan : Scan
            Projections as for `lm.reconstruct`.
        thickness : int
            Slices of a slab.
        progress : Progress or None
            Called as progress(views done in all slabs, views of all slabs, None).

        Yields
        ------
        ndarray
            Float32 [x, y, thickness], from the first slab on; the last may be thinner.

        Raises
        ------
        InputError
            For a scan that `lm.reconstruct` refuses, and for too little memory.

        Examples
        --------
        >>> for slab in FDK().slabs(scan, 64):
        ...     ...
        """
        parts = scan.geometry.grid.slabs(thickness)
        check_memory(scan.geometry.on(scan.geometry.grid.slab(*parts[0])), needed=_slab_memory(scan, parts[0][1]))
        views, n = self.filtered_views(scan), len(scan)
        for k, part in enumerate(parts):

            def report(done, *_):
                if progress:
                    progress(k * n + done, len(parts) * n, None)

            yield views.slab(part, report)

    def filtered_views(self, scan: Scan, file: Path | None = None) -> FilteredViews:
        """Weight and filter all views, for any number of slabs.

        Parameters
        ----------
        scan : Scan
            Projections as for `slabs`.
        file : Path or None
            A new .npy for them (None: in memory). Stored views are filtered when they are needed.

        Returns
        -------
        FilteredViews
            The filtered views, which make slabs.
        """
        images, geometry = self.images(scan)
        if scan.stored is not None:
            return FilteredViews(geometry, (self, scan))
        n_v, n_u = geometry.nDetector
        shape = len(geometry), n_u, n_v
        views = np.empty(shape, np.float32) if file is None else open_memmap(file, 'w+', np.float32, shape)
        for first in range(0, len(geometry), BATCH):
            views[first : first + BATCH] = images(first)
        return FilteredViews(geometry, views if file is None else file)  # which is complete once the array is gone

    def slab_steps(self, scan: Scan, thickness: int) -> int:
        """Return the number of steps of `slabs`, for `progress`.

        Parameters
        ----------
        scan : Scan
            Projections as for `slabs`.
        thickness : int
            Slices of a slab.

        Returns
        -------
        int
            Views times slabs.
        """
        return len(scan) * len(scan.geometry.grid.slabs(thickness))


@dataclass(frozen=True)
class FilteredViews:
    """Filtered views from which slabs are made, here or by a worker.

    Parameters
    ----------
    geometry : CircularGeometry
        Geometry of the views and the whole volume.
    at : ndarray, Path or tuple[FDK, Scan]
        Float32 [view, u, v]; the .npy that holds them; or what they are made of when they are needed.
    """

    geometry: CircularGeometry
    at: np.ndarray | Path | tuple[FDK, Scan]

    def slab(self, part: tuple[int, int], progress: Progress | None = None) -> np.ndarray:
        """Backproject into the slices [begin, end) of the volume, [x, y, z]."""
        if isinstance(self.at, tuple):
            algorithm, scan = self.at
            images = algorithm.images(scan)[0]
        else:
            stored = np.load(self.at, mmap_mode='r') if isinstance(self.at, Path) else self.at
            images = partial(_batch, stored)
        return backprojected(self.geometry.on(self.geometry.grid.slab(*part)), images, progress)


def _batch(views, first):
    return views[first : first + BATCH]


def _slab_memory(scan: Scan, thickness: int) -> float:
    """Peak memory of `FDK.slabs`, bytes: three slabs, the scan, its upright panel if that is another, all filtered views."""
    level = rectified_geometry(scan.geometry, NAME)
    pixels = 0 if level is scan.geometry else prod(level.nDetector)
    pixels += prod(scan.geometry.nDetector) + prod(extended(level)[0].nDetector)
    views = 2 * BATCH + (0 if scan.stored is not None and level is scan.geometry else len(scan))
    return 4 * (3 * prod(scan.geometry.grid.shape[:2]) * thickness + views * pixels)


def _weighted(scan: Scan) -> tuple[Callable[[int], np.ndarray], CircularGeometry]:
    """Projections on an upright panel, rays weighted by how often they were measured, and their geometry.

    The projections are a function of the first of `BATCH` views, for memory.
    """
    level = rectified(scan, NAME)
    circle = require_circle(level, NAME)
    rays = np.broadcast_to(ray_weights(circle)[:, None].astype(np.float32), (len(circle), 1, circle.nDetector[1]))
    geometry, columns = extended(circle)

    def projections(first):
        some = slice(first, first + BATCH)
        return np.pad(level.views(some) * rays[some], ((0, 0), (0, 0), columns))

    return projections, geometry


def backprojected(
    geometry: CircularGeometry, images: Callable[[int], np.ndarray], progress: Progress | None
) -> np.ndarray:
    """The volume [x, y, z] of filtered projections. images: gives the filtered projections of a batch, [view, u, v], by its
    first view."""
    volume = dr.zeros(mi.Float, int(np.prod(geometry.grid.shape)))
    dr.make_opaque(volume)
    matrices, weights = geometry.voxel_matrices(), view_weights(geometry)
    n = len(geometry)
    for first in range(0, n, BATCH):
        batch, views = images(first), []
        for i in range(first, first + BATCH):  # the last batch is filled with views of weight zero
            weight, i = (weights[i], i) if i < n else (0.0, first)
            views.append(
                (
                    mi.Float(np.ascontiguousarray(batch[i - first]).ravel()),
                    [[dr.opaque(mi.Float, float(x)) for x in row] for row in matrices[i]],
                    dr.opaque(mi.Float, float(weight)),
                )
            )
        volume = _add_views(volume, views, geometry)
        dr.eval(volume)
        if progress:
            progress(min(first + BATCH, n), n, None)
    return volume.numpy().reshape(geometry.grid.shape)
