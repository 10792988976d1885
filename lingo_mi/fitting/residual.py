"""Differences between rendered and measured views, beside the noise of the measured views."""

from __future__ import annotations

import numpy as np

from lingo_mi.raw.line_integrals import photons_of_images
from lingo_mi.scan import Scan

MOST_PHOTONS = 1e8  # a pixel: an estimate of less noise than theirs is rounding


def residual_numbers(rendered: np.ndarray, test: Scan) -> dict:
    """The numbers of a residual: rendered minus measured line integrals [view, v, u], in valid pixels.

    Returns
    -------
    dict
        `residual_rms`; `residual_by_view`, the same of each view (None without a valid pixel); and `residual_to_noise`, the rms
        of the residual over the noise of its pixel, which 1 would be noise alone, if the views have noise. The variance of
        the noise is exp(p) / photons, with p as rendered, and photons estimated by `photons_of_images`.
    """
    photons = photons_of_images(test.projections, test.valid)
    squares, scaled, pixels = np.zeros((3, len(rendered)))
    for i, (image, measured) in enumerate(zip(rendered, test.projections)):  # one by one, for memory
        valid = np.ones(image.shape, bool) if test.valid is None else test.valid[i]
        p = image[valid].astype(np.float64)
        square = np.square(p - measured[valid])
        squares[i], scaled[i], pixels[i] = square.sum(), (square / np.exp(np.maximum(p, 0))).sum(), valid.sum()
    numbers: dict = dict(
        residual_rms=float(np.sqrt(squares.sum() / pixels.sum())),
        residual_by_view=[float(np.sqrt(s / n)) if n else None for s, n in zip(squares, pixels)],
    )
    if photons < MOST_PHOTONS:
        numbers['residual_to_noise'] = float(np.sqrt(photons * scaled.sum() / pixels.sum()))
    return numbers
