"""Poses as ASTRA's vectors, 12 numbers a view: `cone_vec` and `parallel3d_vec`.

    cone_vec         source, panel's centre, u, v
    parallel3d_vec   direction of the beam, panel's centre, u, v

each (x, y, z), u and v one pixel long: from pixel (0, 0) to its neighbour in the row, and in the column. ASTRA's world is
this package's, in mm. Its arrays are [v, view, u] and volumes [z, y, x]: transpose them. Nothing is assumed about where a
row lies: vectors made by ASTRA's own `geom_2vec` have v along +z, this package's scanners v along -z, and both mean the
same as long as they stay with their projections.

ASTRA documentation, "3D geometries".
"""

from __future__ import annotations

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.geometry.rays import Rays


def to_vectors(frames: Rays, nDetector) -> np.ndarray:
    """ASTRA's vectors of the views, float64 [n, 12]; nDetector is (v, u) pixels."""
    return np.concatenate([frames.source, frames.centre(nDetector), frames.u, frames.v], 1)


def from_vectors(vectors, nDetector, parallel: bool) -> Rays:
    """The views of ASTRA's vectors [n, 12]; nDetector is (v, u) pixels. InputError where they are no poses."""
    try:
        vectors = np.asarray(vectors, float)
    except (TypeError, ValueError):
        raise InputError('poses must be 12 numbers for every view') from None
    if vectors.ndim != 2 or vectors.shape[1] != 12 or not len(vectors):
        raise InputError(
            f'poses must be 12 numbers for every view (source, centre of the panel, u, v), not an array of '
            f'shape {vectors.shape}'
        )
    source, centre, u, v = vectors[:, :3], vectors[:, 3:6], vectors[:, 6:9], vectors[:, 9:]
    corner = centre - nDetector[1] / 2 * u - nDetector[0] / 2 * v
    return Rays(source, corner, u, v, parallel).checked()
