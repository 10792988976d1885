"""What a fit takes of its scan: the pixels it trusts, their weights, the effects it models, the unit of density."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

from lingo_mi.effects.forward import Effects
from lingo_mi.errors import InputError
from lingo_mi.fitting.settings import Settings
from lingo_mi.reconstruction import effects_correction as corrections
from lingo_mi.reconstruction.preconditions import require_signal
from lingo_mi.scan import Scan


def modelled_effects(scan: Scan, settings: Settings) -> Effects | None:
    """The scan's effects that the fit models; None where it takes the projections for line integrals, because the scan has
    none or they are ignored."""
    effects = scan.effects if settings.model.effects == 'model' else None
    return None if effects is None or effects.ideal else effects


def weights_of(scan: Scan, settings: Settings) -> np.ndarray | None:
    """What pixels are multiplied by before they are compared, float32 [view, v, u]; None where they are as they are.

    One over the standard deviation of a pixel's noise, so that all have the same (as the weights of penalised weighted least
    squares, Sauer and Bouman, IEEE Trans. Signal Process. 41, 1993, which are squares of these). It follows the mean signal of
    3 x 3 valid pixels: by its own noise alone a pixel that came out dark would count for less than a bright one. The largest
    projection stays as large as it was, for the sake of the loss's constants.

    Raises InputError for a scan that says neither how many photons it has counted nor its bit depth.
    """
    if settings.loss.weights == 'equal':
        return None
    detector = scan.effects.detector if scan.effects else None
    if not (detector and (detector.photons or detector.bits)):
        raise InputError('weights=noise needs a ct_detector with photons or bits in the scene, or leave it out')
    p = scan.projections
    valid = np.ones(p.shape) if scan.valid is None else scan.valid.astype(float)
    size: Any = 0, 3, 3  # SciPy declares one number
    light, share = (ndimage.uniform_filter(a, size, mode='nearest') for a in (np.exp(-p.astype(float)) * valid, valid))
    weights = 1 / detector.deviation(light / np.maximum(share, 0.1))
    return (weights * (p.max() / (weights * p).max())).astype(np.float32)


def trusted(scan: Scan, settings: Settings) -> Scan:
    """The scan without the pixels that its detector knows to be dead."""
    effects = scan.effects if settings.model.effects == 'model' else None
    return scan if effects is None else effects.masked(scan)


def linearised(scan: Scan, settings: Settings) -> Scan:
    """A scan of line integrals at the reference energy for what knows no effects: initial clouds, FDK."""
    effects = scan.effects if settings.model.effects == 'model' else None
    return scan if effects is None else corrections.linearised(scan, effects)


def density_unit(scan: Scan, settings: Settings) -> float:
    """The density, in 1/mm, that a fit counts as 1: see `normalise` of the settings. Raises InputError for an empty scan."""
    require_signal(scan, 'fit')
    return float(scan.projections.max()) * scan.geometry.scale if settings.model.normalise else 1.0
