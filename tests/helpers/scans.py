"""A small scan with a number of its own in every place, to write and read again."""

import numpy as np

from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.scan import Dataset, Scan


def small_dataset(mode: str = 'cone') -> Dataset:
    """Three views of 4 x 6 pixels and two held out, with a true volume of 5 x 6 x 7 voxels: random densities up to 3."""
    rng = np.random.default_rng(1)
    geometry = CircularGeometry(
        mode=mode,
        DSO=900,
        DSD=1400,
        nDetector=(4, 6),
        dDetector=(1.5, 2.5),
        angles=[0.1, 0.7, 3.0],
        offDetector=(4, -5),
        grid=Grid((5, 6, 7), (1, 2, 3), (1, -2, 3)),
    )
    return Dataset(
        Scan(geometry, rng.random((3, 4, 6)) + 1),
        Scan(geometry.subset([2, 0]), rng.random((2, 4, 6))),
        rng.random((5, 6, 7)).astype(np.float32) * 3,
    )
