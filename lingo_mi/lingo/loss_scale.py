"""The paper's loss scale T_g + 1 / (4 T_g) from Otsu's threshold of a rendered image (section III-C), on the device."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

BINS = 256
FLOOR = 0.01  # least T_g, which keeps the scale of an empty image finite (paper, section III-C)
LANES = 32  # histograms per CPU thread


def loss_scale(image: Any) -> Any:
    """T_g + 1 / (4 T_g) with T_g = max(FLOOR, `otsu_on_device`(image)): Float of width 1, detached.

    Parameters
    ----------
    image : Float [N]
        Line integrals.
    """
    threshold = dr.maximum(otsu_on_device(image), FLOOR)
    return threshold + 0.25 / threshold


def otsu_on_device(image: Any) -> Any:
    """Otsu's threshold, which maximises the variance between two classes: Float of width 1, detached.

    The histogram has 256 bins between the smallest and the largest value. The threshold is the centre of a bin, the
    lowest of equally good ones, as in `skimage.filters.threshold_otsu` (rounding may put a value into the next bin). For
    a constant image, its value is returned.

    Otsu, "A threshold selection method from gray-level histograms", IEEE Trans. SMC 9 (1979).

    Parameters
    ----------
    image : Float [N]
        Any unit.
    """
    image = dr.detach(image)
    low, high = dr.min(image), dr.max(image)
    dr.make_opaque(image, low, high)
    histogram = _histogram(image, low, high)
    dr.eval(histogram)
    threshold = low + (mi.Float(_best_bin(histogram)) + 0.5) * ((high - low) / BINS)
    threshold = dr.select(high > low, threshold, low)
    dr.eval(threshold)  # in a kernel of one lane, not in every lane of a later kernel
    return threshold


def _histogram(image, low, high):
    """Pixel counts of BINS equal bins from low to high, UInt32 [BINS]; zeros for a constant image."""
    if dr.backend_v(image) == dr.JitBackend.LLVM:
        lanes = LANES * dr.thread_count()
        histograms = dr.zeros(mi.UInt32, BINS * lanes)
        dr.make_opaque(histograms)
        dr.eval(_count(image, low, high, dr.arange(mi.UInt32, lanes), lanes, histograms), histograms)
        return dr.block_sum(histograms, lanes)
    histogram = dr.zeros(mi.UInt32, BINS)
    # Most pixels may fall into one bin, so counts are first added within a warp.
    dr.scatter_add(histogram, mi.UInt32(1), _bin(image, low, high), high > low, mode=dr.ReduceMode.Local)
    return histogram


def _bin(value, low, high):
    # The maximum belongs to the last bin. NaN goes there too, since it has no bin.
    return dr.minimum(mi.UInt32((value - low) * (BINS / (high - low))), BINS - 1)


@dr.syntax
def _count(image, low, high, lane, lanes, target):
    """Each lane counts its share of the pixels in its own histogram, without atomics."""
    i = mi.UInt32(lane)
    end = dr.select(high > low, mi.UInt32(dr.width(image)), 0)
    while i < end:
        place = _bin(dr.gather(mi.Float, image, i), low, high) * lanes + lane
        dr.scatter(target, dr.gather(mi.UInt32, target, place) + 1, place)
        i += lanes
    return i


@dr.syntax
def _best_bin(histogram):
    """The last bin of the lower class. Computed in one lane: 256 steps cost less than launching another kernel.

    Let n be the number of pixels and s the sum of their bin numbers; n1 and s1 are the same numbers for the lower class. Then the
    variance between the classes is (n s1 - n1 s)^2 / (n1 (n - n1)), up to a constant factor.
    """
    Float64: Any = dr.float64_array_t(mi.Float)
    i, n, s = mi.UInt32(0), Float64(0), Float64(0)
    while i < BINS:
        count = Float64(dr.gather(mi.UInt32, histogram, i))
        n += count
        s += count * Float64(i)
        i += 1
    i, best, most = mi.UInt32(0), mi.UInt32(0), Float64(-1)
    n1, s1 = Float64(0), Float64(0)
    while i < BINS - 1:
        count = Float64(dr.gather(mi.UInt32, histogram, i))
        n1 += count
        s1 += count * Float64(i)
        variance = dr.square(n * s1 - n1 * s) / (n1 * (n - n1))
        if variance > most:
            best, most = i, variance
        i += 1
    return best
