"""The .pca of GE's (Waygate's) phoenix datos|x: a circle."""

from __future__ import annotations

from os import PathLike

import numpy as np

from lingo_mi.raw.recording import Taken
from lingo_mi.raw.settings import Settings


def read_pca(path: PathLike | str) -> Taken:
    """The circular scan that a .pca describes: FDD and FOD are the distances from the focus to detector and object, mm.

    Raises
    ------
    InputError
        If the file is missing or damaged, or lacks a number.
    """
    pca = Settings.read(path, '.pca', 'Geometry')
    n, DSO, DSD = pca.circle(('CT', 'NumberImages'), ('Geometry', 'FOD'), ('Geometry', 'FDD'))
    pca.warn_unread([name for name in ('CalibValue', 'DetectorRot', 'Tilt') if pca.number('Geometry', name, 0.0)])
    return Taken(
        dict(
            DSO=DSO,
            DSD=DSD,
            dDetector=[pca.number('Detector', f'Pixelsize{axis}') for axis in 'YX'],
            angles=(pca.number('CT', 'RotationSector', 360.0) / n * np.arange(n)).tolist(),
        )
    )
