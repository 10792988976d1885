"""Image quality in 2D (projections) and 3D (volumes). Pure NumPy and SciPy, in float64, a few views or slabs at a time.

Each measure comes in two forms. The plain name is the absolute one, and `_r2` is R2-Gaussian's:

- `psnr_2d`, `ssim_2d`: line integrals as they are, one full scale for all views: the largest true value. A wrong gain counts as
  the error it is.
- `psnr_3d`, `ssim_3d`: full scale is the largest true density, in whatever unit; the window of SSIM is as thick as it is wide.
- `psnr_2d_r2`, `ssim_2d_r2`: every view of either stack is divided by its own maximum, so a wrong gain costs nothing.
- `psnr_3d_r2`, `ssim_3d_r2`: full scale 1, nothing rescaled or clipped, SSIM slice by slice.

Published tables hold R2-Gaussian's forms.

Every function takes the result first and the truth second, raises InputError if the shapes differ or a
value is not finite, and returns a float: inf dB for identical images, NaN if the truth holds nothing to
compare with.

References: Zha et al., "R2-Gaussian", NeurIPS 2024 (its forms); Wang et al., "Image quality assessment:
from error visibility to structural similarity", IEEE TIP 2004 (SSIM).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import correlate1d

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import cores

WINDOW = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
WINDOW /= WINDOW.sum()
C1, C2 = 0.01**2, 0.03**2
# Values that are made float64 at once: a large volume as a whole, with temporaries, would take ten times its own memory.
SLAB = 2**23
THREADS = 8  # at most, and fewer for large views


def psnr_2d_r2(images: ArrayLike, truth: ArrayLike) -> float:
    """PSNR in dB as R2-Gaussian reports it: views divided by their own maxima, peak 1, mean over the views.

    images, truth : [view, v, u]. Views whose truth has no positive pixel are left out; an image without a
    positive pixel is compared undivided.
    """
    images, truth = _pair(images, truth, 'projections', '[view, v, u]')
    return _mean(_each(lambda a, b: _psnr(a, b, 1.0), _scaled_to_maximum(images, truth), images[0].size))


def psnr_2d(images: ArrayLike, truth: ArrayLike, peak: float | None = None) -> float:
    """PSNR in dB of line integrals as they are, mean over the views.

    Parameters
    ----------
    images, truth : array_like [view, v, u]
    peak : float or None
        The value that counts as full scale, > 0; by default the maximum of the whole truth.
    """
    images, truth = _pair(images, truth, 'projections', '[view, v, u]')
    peak = _peak(truth, peak)
    return _mean(_each(lambda a, b: _psnr(a, b, peak), zip(images, truth), images[0].size)) if peak > 0 else np.nan


def ssim_2d_r2(images: ArrayLike, truth: ArrayLike) -> float:
    """SSIM as R2-Gaussian reports it: each view divided by its own maximum, mean over the views.

    Parameters
    ----------
    images, truth : array_like [view, v, u]
        Views whose truth has no positive pixel are left out.
    """
    images, truth = _pair(images, truth, 'projections', '[view, v, u]')
    return _mean(_each(_ssim, _scaled_to_maximum(images, truth), images[0].size))


def ssim_2d(images: ArrayLike, truth: ArrayLike, peak: float | None = None) -> float:
    """SSIM of line integrals with one full scale for both stacks, mean over the views.

    Parameters
    ----------
    images, truth : array_like [view, v, u]
    peak : float or None
        The value that counts as full scale, > 0; by default the maximum of the whole truth.
    """
    images, truth = _pair(images, truth, 'projections', '[view, v, u]')
    peak = _peak(truth, peak)
    return _mean(_each(lambda a, b: _ssim(a, b, peak), zip(images, truth), images[0].size)) if peak > 0 else np.nan


def psnr_3d_r2(volume: ArrayLike, truth: ArrayLike) -> float:
    """PSNR in dB with peak 1, neither volume rescaled or clipped.

    Parameters
    ----------
    volume, truth : array_like [x, y, z]
        The number is meaningful if the truth's densities fill [0, 1].
    """
    return _psnr(*_pair(volume, truth, 'volumes', '[x, y, z]'), 1.0)


def ssim_3d_r2(volume: ArrayLike, truth: ArrayLike) -> float:
    """SSIM of all slices with full scale 1: mean over the slices of an axis, then over the three axes.

    volume, truth : [x, y, z]. Slices whose truth has no positive voxel are left out. So is an axis whose
    slices are one voxel thin: a fan-beam volume [x, y, 1] is measured in its plane alone.
    """
    volume, truth = _pair(volume, truth, 'volumes', '[x, y, z]')
    means = []
    for axis in range(3):
        a, b = np.moveaxis(volume, axis, 0), np.moveaxis(truth, axis, 0)
        if min(a.shape[1:]) > 1 or max(a.shape) == 1:
            # One slice at a time: its few temporaries stay in the cache.
            means.append(_mean(_each(_ssim, ((x, y) for x, y in zip(a, b) if y.max() > 0), a[0].size)))
    return _mean(means)


def psnr_3d(volume: ArrayLike, truth: ArrayLike, peak: float | None = None) -> float:
    """PSNR in dB of densities in any unit.

    Parameters
    ----------
    volume, truth : array_like [x, y, z]
    peak : float or None
        The value that counts as full scale, > 0; by default the maximum of the truth.
    """
    volume, truth = _pair(volume, truth, 'volumes', '[x, y, z]')
    peak = _peak(truth, peak)
    return _psnr(volume, truth, peak) if peak > 0 else np.nan


def ssim_3d(volume: ArrayLike, truth: ArrayLike, peak: float | None = None) -> float:
    """SSIM of densities in any unit, with a window of 11 x 11 x 11 voxels, mean over all of them.

    Parameters
    ----------
    volume, truth : array_like [x, y, z]
        Along an axis of one voxel there is no window.
    peak : float or None
        The value that counts as full scale, > 0; by default the maximum of the truth.
    """
    volume, truth = _pair(volume, truth, 'volumes', '[x, y, z]')
    peak = _peak(truth, peak)
    axes = [axis for axis in range(3) if truth.shape[axis] > 1]
    if peak <= 0:
        return np.nan
    reach = len(WINDOW) // 2

    def of(slab):
        low = max(slab.start - reach, 0)
        near = slice(low, slab.stop + reach)  # the window of the slab's voxels reaches that far
        similarity = ssim_map(volume[near].astype(float) / peak, truth[near].astype(float) / peak, axes)
        return similarity[slab.start - low : slab.stop - low].sum()

    size = (_thickness(truth) + 2 * reach) * truth[0].size
    return float(sum(_each(of, ((slab,) for slab in _slabs(truth)), size)) / truth.size)


def compared(volume: ArrayLike, truth: ArrayLike) -> dict[str, float | None]:
    """PSNR and SSIM of a volume [x, y, z], each in both forms, by name; None if the value is not finite.

    compared(found.volume, truth)['psnr_3d']
    """
    values = {f.__name__: f(volume, truth) for f in (psnr_3d, ssim_3d, psnr_3d_r2, ssim_3d_r2)}
    return {name: value if np.isfinite(value) else None for name, value in values.items()}


def ssim_map(a: np.ndarray, b: np.ndarray, axes: Sequence[int] = (0, 1)) -> np.ndarray:
    """SSIM of two images [rows, columns], or volumes, at every pixel, for values with full scale 1.

    The window is a Gaussian of sigma 1.5, 11 wide along each of the `axes`, the image is continued by zeros, variances are
    not debiased: the form of the SSIM loss of 3D Gaussian Splatting.
    """

    def blur(x):
        for axis in axes:
            x = correlate1d(x, WINDOW, axis, mode='constant')
        return x

    ma, mb = blur(a), blur(b)
    mab, mm = ma * mb, ma * ma + mb * mb
    # The two variances enter as a sum only, which saves one of five blurs.
    return (2 * mab + C1) * (2 * (blur(a * b) - mab) + C2) / ((mm + C1) * (blur(a * a + b * b) - mm + C2))


def _pair(a, b, what, axes):
    """Both arrays, checked."""
    a, b = (np.asarray(x) for x in (a, b))
    a, b = (x if x.dtype.kind in 'fiub' else x.astype(float) for x in (a, b))
    if a.shape != b.shape or a.ndim != 3 or a.size == 0:
        raise InputError(f'the {what} have the shapes {a.shape} and {b.shape}: both must be the same {axes}')
    for x, name in ((a, 'result'), (b, 'truth')):
        for slab in _slabs(x):
            if not (finite := np.isfinite(x[slab])).all():
                first, *rest = (int(i) for i in np.argwhere(~finite)[0])
                at = [slab.start + first, *rest]
                raise InputError(f'the {what} of the {name} contain NaN or infinity, first at {axes} = {at}')
    return a, b


def _slabs(array: np.ndarray) -> Iterator[slice]:
    """Slices of the first axis, of at most `SLAB` values each, or one long."""
    thickness = _thickness(array)
    for start in range(0, len(array), thickness):
        yield slice(start, min(start + thickness, len(array)))


def _thickness(array):
    return max(1, SLAB // max(1, array[0].size))


def _peak(truth, peak):
    if peak is None:
        return float(truth.max())
    if not (np.isfinite(peak) and peak > 0):
        raise InputError(f'the peak of a quality measure must be positive, not {peak!r}')
    return float(peak)


def _scaled_to_maximum(images, truth):
    for a, b in zip(images, truth):
        a, b = a.astype(float), b.astype(float)
        if b.max() > 0:
            yield a / (a.max() if a.max() > 0 else 1.0), b / b.max()


def _each(function, items, size):
    """The function of each of the items, which are tuples of arguments, in their order, on threads: NumPy and SciPy work without
    Python's lock. Only so many items are taken in advance as there are threads, with three slabs of values together, or one item.

    Parameters
    ----------
    size
        Values of an item.
    """
    threads = max(1, min(cores(), THREADS, 3 * SLAB // size))
    with ThreadPoolExecutor(threads) as pool:
        running: deque = deque()
        for item in items:
            if len(running) == threads:
                yield running.popleft().result()
            running.append(pool.submit(function, *item))
        while running:
            yield running.popleft().result()


def _ssim(a, b, peak=1.0):
    return ssim_map(a.astype(float, order='C') / peak, b.astype(float, order='C') / peak).mean()


def _psnr(a, b, peak):
    error = float(sum(np.sum((a[s].astype(float) - b[s]) ** 2) for s in _slabs(a)) / a.size)
    return float(10 * np.log10(peak**2 / error)) if error > 0 else np.inf


def _mean(values):
    values = list(values)
    return float(np.mean(values)) if values else np.nan
