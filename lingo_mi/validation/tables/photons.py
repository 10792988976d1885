"""Projections as photons count them: the noise of the tables' scans."""

from __future__ import annotations

import numpy as np

from lingo_mi.effects.detector import Detector

LARGEST = 4.0  # line integral of a scan: 1.8 % of the photons arrive


def counting(photons: float, electronic_noise: float = 0.0) -> Detector:
    """A detector that counts so many photons a pixel in the open beam; its electronics' noise is in photons.

    Raises
    ------
    InputError
        For values out of their ranges.
    """
    return Detector.of(**(Detector.DEFAULTS | dict(photons=photons, electronic_noise=electronic_noise)))


def noisy(views: np.ndarray, detector: Detector, seed: int = 0) -> np.ndarray:
    """Line integrals [view, v, u] as a detector reports them."""
    return np.stack([detector.measure(np.exp(-view.astype(float)), i, seed) for i, view in enumerate(views)])
