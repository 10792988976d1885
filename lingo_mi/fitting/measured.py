"""What a fit uses of its scan: trusted pixels, their weights, modelled effects, the unit of density."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.settings import Settings
from lingo_mi.reconstruction import effects_correction as corrections
from lingo_mi.reconstruction.preconditions import require_signal
from lingo_mi.scan import Scan


def modelled_effects(scan: Scan, settings: Settings) -> Effects | None:
    """The scan's effects that the fit models. None if the scan has none or the settings ignore them: the fit then treats
    projections as line integrals."""
    effects = scan.effects if settings.model.effects == 'model' else None
    return None if effects is None or effects.ideal else effects


def weights_of(scan: Scan, settings: Settings) -> np.ndarray | None:
    """Factors of the pixels before comparison, float32 [view, v, u]; None: no weighting.

    A weight is 1 / (standard deviation of the pixel's noise), so that all weighted pixels have the same noise. (Its square is
    the weight of penalised weighted least squares: Sauer and Bouman, IEEE Trans. Signal Process. 41, 1993.) The noise is
    computed from the mean signal of 3 x 3 valid pixels: from the pixel alone, a pixel that is dark by chance would weigh less
    than a bright one. The weights are scaled to keep the largest projection, to which SSIM's constants refer.

    Raises InputError for a scan with neither a photon count nor a bit depth.
    """
    if settings.loss.weights == 'equal':
        return None
    detector = scan.effects.detector if scan.effects else None
    if not (detector and (detector.photons or detector.bits)):
        raise InputError('weights=noise needs a ct_detector with photons or bits in the scene, or leave it out')
    weights = np.empty_like(scan.projections)
    for i, p in enumerate(scan.projections):  # view by view, for memory
        valid = np.ones(p.shape) if scan.valid is None else scan.valid[i].astype(float)
        light, share = (ndimage.uniform_filter(a, 3, mode='nearest') for a in (np.exp(-p.astype(float)) * valid, valid))
        weights[i] = 1 / detector.deviation(light / np.maximum(share, 0.1))
    weighted = max((w * p).max() for w, p in zip(weights, scan.projections))
    weights *= scan.projections.max() / weighted
    return weights


def knows_noise(scan: Scan) -> bool:
    """Whether the photons of a pixel in the open beam are known."""
    return bool(scan.effects and scan.effects.detector and scan.effects.detector.photons)


def trusted(scan: Scan, settings: Settings) -> Scan:
    """The scan without the detector's known dead pixels."""
    effects = scan.effects if settings.model.effects == 'model' else None
    return scan if effects is None else effects.masked(scan)


def linearised(scan: Scan, settings: Settings) -> Scan:
    """Line integrals at the reference energy, for methods without a model of effects: initial clouds, FDK."""
    effects = scan.effects if settings.model.effects == 'model' else None
    return scan if effects is None else corrections.linearised(scan, effects)


def density_unit(scan: Scan, settings: Settings) -> float:
    """A fit's unit of density, 1/mm; see the setting `normalise`. Raises InputError for an empty scan."""
    require_signal(scan, 'fit')
    return float(scan.projections.max()) * scan.geometry.scale if settings.model.normalise else 1.0
