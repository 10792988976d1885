"""Otsu's threshold (paper, section II-A). Pure NumPy and scikit-image."""

from __future__ import annotations

import numpy as np
from skimage.filters import threshold_otsu

BINS = 256


def otsu(image: np.ndarray) -> float:
    """The threshold t* = Otsu(I) that maximises the between-class variance, in the image's own units.

    The histogram has 256 bins between the image's smallest and largest value. The threshold is a bin centre,
    and pixels *above* it are foreground. For a constant image its value is returned, so no pixel is above it.
    (The paper writes "intra-class variance"; Otsu's criterion is the variance between the classes.)
    """
    image = np.asarray(image, np.float32)
    if np.ptp(image) < 2 * BINS * np.spacing(np.abs(image).max()):
        image = image.astype(float)  # constant but for rounding: in float32 its bins have no edges
    return float(threshold_otsu(image, nbins=BINS))
