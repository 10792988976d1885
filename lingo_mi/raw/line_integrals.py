"""From counts to line integrals: ln of the flat field over the view, both without the dark one.

    p = ln( (flat - dark) exposure / (view - dark) )

Without flats, the air level of each view stands for the flat field: its mean in a region of air, or a high percentile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter, rank_filter

from lingo_mi.common.errors import InputError
from lingo_mi.raw.recording import Frames

DEAD = 0.5  # a pixel is bad if its gain differs from its neighbours' by this part
DIFFERENCE = (1, -4, 6, -4, 1)
MOST_VIEWS = 64  # most views whose noise is measured
FULL = 0.9  # a flat with more of its pixels saturated is not usable
UNLIKE = 0.5  # a flat below this part of the others' brightness, or above its inverse, is not a flat
OUTLIER, BRIGHTER = 8.0, 1.1  # an outlier is brighter than its neighbours by so many standard deviations, and times
HOT = 0.05  # a pixel is bad if its dark count is this part of the flat's counts off its neighbours'


@dataclass(frozen=True)
class Fields:
    """Images of the panel without an object.

    Parameters
    ----------
    dark : ndarray [v, u]
        Counts.
    flat : ndarray [v, u] or None
        Counts above the dark ones; None without flats.
    good : bool [v, u]
        Neither dead nor hot.
    photons : float or None
        A pixel of a flat, from the scatter of the flats; None with fewer than two.
    """

    dark: np.ndarray
    flat: np.ndarray | None
    good: np.ndarray
    photons: float | None

    def part(self, region: Callable[[np.ndarray], np.ndarray]) -> Fields:
        """Return the part of each image that `region` keeps."""
        flat = None if self.flat is None else region(self.flat)
        return replace(self, dark=region(self.dark), flat=flat, good=region(self.good))


def fields(shape: tuple[int, int], flats: Frames | None, darks: Frames | None, saturation: float = np.inf) -> Fields:
    """The mean dark and flat field, the pixels that are good, and the photons of a pixel.

    The photons are the number whose Poisson noise has the same scatter: mean^2 / variance of a pixel over the flats, each
    divided by its brightness first. A pixel that reaches `saturation`, in counts, in a flat is not good.

    Raises
    ------
    InputError
        If a panel has another size than `shape`, the flats are dark or saturated, or one is unlike the others.
    """
    for name, frames in (('flats', flats), ('darks', darks)):
        if frames is not None and frames.shape != shape:
            raise InputError(f'{frames.where}: the {name} have {frames.shape} pixels, but the views have {shape}')
    dark = np.zeros(shape)
    if darks is not None:
        for i in range(len(darks)):
            dark += darks[i] / len(darks)
    good = np.isfinite(dark)
    if not good.any():
        raise InputError(f'{darks.where if darks else ""}: no pixel of the dark frames holds a number; give others')
    dark = np.where(good, dark, np.median(dark[good]))
    if flats is None:
        return Fields(dark, None, good & _near(dark, np.ptp(np.percentile(dark, [5, 95]))), None)
    total, square = np.zeros(shape), np.zeros(shape)
    bright = np.zeros(len(flats))
    for i in range(len(flats)):
        counts = flats[i]
        frame = counts - dark
        good &= np.isfinite(frame) & (counts < saturation)
        if (counts >= saturation).mean() > FULL:
            raise InputError(
                f'{flats.where}: nearly all pixels of flat {i} reach the saturation, {saturation:g} counts; give flats of '
                'a shorter exposure and exposure=X of the views over theirs, or air=(v0, v1, u0, u1)'
            )
        bright[i] = np.median(frame[np.isfinite(frame)]) if np.isfinite(frame).any() else 0.0
        if not bright[i] > 0:
            raise InputError(
                f'{flats.where}: flat {i} is not brighter than the dark frames; are flats and darks swapped?'
            )
        frame = np.where(good, frame / bright[i], 1.0)
        total += frame
        square += frame**2
    n, typical = len(flats), np.median(bright)
    if (odd := np.flatnonzero((bright < UNLIKE * typical) | (bright > typical / UNLIKE))).size:
        raise InputError(
            f'{flats.where}: flat {odd[0]} is {bright[odd[0]] / typical:.2g} times as bright as the others; take it out'
        )
    mean = total / n
    flat = mean * bright.mean()
    local = median_filter(mean, 5)
    good &= np.isfinite(flat) & (flat > 0) & (np.abs(mean - local) < DEAD * local) & _near(dark, flat)
    photons = None
    if n > 1 and good.any():
        spread = np.maximum(square - n * mean**2, 0)[good] / (n - 1) / mean[good] ** 2
        photons = float(1 / spread.mean()) if spread.mean() > 0 else None
    return Fields(dark, flat, good, photons)


def _near(dark, signal):
    """Return the mask of the pixels whose dark counts are like their neighbours'."""
    off = np.abs(dark - median_filter(dark, 5))
    return off <= np.maximum(HOT * np.median(signal), 12 * 1.4826 * np.median(off) + 1)


def counts_to_line_integrals(
    view: np.ndarray,
    fields: Fields,
    bins: tuple[int, int],
    exposure: float = 1.0,
    saturation: float = np.inf,
    outliers: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Line integrals of one view [v, u], and the mask of its valid pixels [v, u].

    A binned pixel with fewer than half of its pixels good is not valid, nor one without counts.

    Parameters
    ----------
    view : ndarray
        Counts [v, u].
    bins : tuple[int, int]
        (v, u) pixels that become one: their counts are added, bad ones left out, before the logarithm.
    exposure : float
        Exposure of this view over the exposure of the flats; without flats its air level in counts.
    saturation : float
        Counts from here on are not valid.
    outliers : bool
        Whether `bright_outliers` are left out.
    """
    counts = view - fields.dark
    good = fields.good & np.isfinite(counts) & (view < saturation)
    full = np.full(view.shape, exposure) if fields.flat is None else fields.flat * exposure
    if outliers:
        good &= ~bright_outliers(counts, full, good)
    bv, bu = bins
    rows, columns = view.shape[0] // bv, view.shape[1] // bu

    def summed(values):
        return values[: rows * bv, : columns * bu].reshape(rows, bv, columns, bu).sum((1, 3))

    signal, air = (summed(np.where(good, x, 0)) for x in (counts, full))
    valid = (2 * summed(good.astype(float)) >= bv * bu) & (signal > 0) & (air > 0)
    return np.log(np.where(valid, air, 1) / np.where(valid, signal, 1)), valid


def bright_outliers(counts: np.ndarray, full: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Pixels that are far brighter than those around them, bool [v, u]: zingers, which photons make that hit the sensor itself.

    Far brighter is more than the fifth brightest of 5 x 5 pixels, by `OUTLIER` standard deviations and `BRIGHTER` times. So up to
    four pixels beside each other are found, and a crack, which crosses all five rows, is not.

    Parameters
    ----------
    counts, full : ndarray
        Counts of the view and of the unattenuated beam, without dark counts, [v, u].
    good : ndarray
        Bool, likewise: pixels that are looked at.
    """
    if not good.any():
        return np.zeros(good.shape, bool)
    light = np.where(good, counts / np.where(full > 0, full, 1), 0)
    root = np.sqrt(np.maximum(median_filter(light, 3), 1e-12))  # the noise of counts grows as their root
    noise = 1.4826 * np.median(np.abs(light - root**2)[good] / root[good])
    around = rank_filter(light, -5, 5)
    return good & (light > BRIGHTER * around) & (light - around > OUTLIER * noise * root)


def photons_of_images(projections: np.ndarray, valid: np.ndarray | None = None) -> float:
    """Photons a pixel before the object, from how line integrals [view, v, u] scatter from column to column.

    The variance of a line integral p is exp(p) / photons. Fourth differences along rows remove what is smooth, their median
    what has edges. Of many views, MOST_VIEWS are measured. Pixels that a detector's blur correlates look less noisy, so this is
    then too many. inf without noise.
    """
    some = np.unique(np.linspace(0, projections.shape[0] - 1, MOST_VIEWS).astype(int))
    p = np.stack([projections[i] for i in some]).astype(np.float64)
    n = p.shape[-1] - len(DIFFERENCE) + 1
    if n < 1:
        return np.inf
    parts = [(w, slice(k, k + n)) for k, w in enumerate(DIFFERENCE)]
    difference = sum(w * p[..., part] for w, part in parts)
    power = sum(w**2 * np.exp(p[..., part]) for w, part in parts)
    scaled = np.abs(difference) / np.sqrt(power)
    if valid is not None:
        scaled = scaled[np.logical_and.reduce([valid[some][..., part] for _, part in parts])]
    scaled = scaled[scaled > 0]  # if all are exactly alike, there was nothing to count
    sigma = 1.4826 * np.median(scaled) if scaled.size else 0.0
    return float(1 / sigma**2) if sigma > 0 else np.inf
