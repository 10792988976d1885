"""The part of a scan that a fit uses: trusted pixels, their weights, modelled effects, the unit of density."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import Effects, effects_of
from lingo_mi.reconstruction.preconditions import require_signal
from lingo_mi.scan import Scan


def modelled_effects(scan: Scan, effects: str) -> Effects | None:
    """The scan's effects that a fit models. None if the scan has none, or if the fit ignores them and takes projections for line
    integrals. effects: of the method, 'model' or 'ignore'."""
    modelled = effects_of(scan) if effects == 'model' else None
    return None if modelled is None or modelled.ideal else modelled


def weights_of(scan: Scan, weights: str) -> np.ndarray | None:
    """Factors of the pixels before comparison, float32 [view, v, u]; None: no weighting.

    A weight is 1 / (standard deviation of the pixel's noise), so that all weighted pixels have the same noise. (Its square is
    the weight of penalised weighted least squares: Sauer and Bouman, IEEE Trans. Signal Process. 41, 1993.) The noise is
    computed from the mean signal of 3 x 3 valid pixels: from the pixel alone, a pixel that is dark by chance would weigh less
    than a bright one. The weights are scaled to keep the largest projection, to which SSIM's constants refer.

    Raises
    ------
    InputError
        For a scan with neither a photon count nor a bit depth.
    """
    if weights == 'equal':
        return None
    effects = effects_of(scan)
    detector = effects.detector if effects else None
    if not (detector and (detector.photons or detector.bits)):
        raise InputError(
            'weights=noise needs a ct_detector with photons or bits in the scene: add one, or leave weights out'
        )
    factors = np.empty_like(scan.projections)
    for i, p in enumerate(scan.projections):  # view by view, for memory
        valid = np.ones(p.shape) if scan.valid is None else scan.valid[i].astype(float)
        light, share = (ndimage.uniform_filter(a, 3, mode='nearest') for a in (np.exp(-p.astype(float)) * valid, valid))
        factors[i] = 1 / detector.deviation(light / np.maximum(share, 0.1))
    weighted = max((w * p).max() for w, p in zip(factors, scan.projections))
    factors *= scan.projections.max() / weighted
    return factors


def knows_noise(scan: Scan) -> bool:
    """Return whether the photons of a pixel in the open beam are known."""
    effects = effects_of(scan)
    return bool(effects and effects.detector and effects.detector.photons)


def trusted(scan: Scan, effects: str) -> Scan:
    """The scan without the detector's known dead pixels."""
    fitted_effects = effects_of(scan) if effects == 'model' else None
    return scan if fitted_effects is None else fitted_effects.masked(scan)


def density_unit(scan: Scan, normalise: bool) -> float:
    """The density that a fit counts as 1, in 1/mm; see `CloudMethod.normalise`.

    Raises
    ------
    InputError
        For an empty scan.
    """
    require_signal(scan, 'fit')
    return float(scan.projections.max()) * scan.geometry.grid.scale if normalise else 1.0
