"""Whether given poses are those of a circular scan."""

from __future__ import annotations

import numpy as np

from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import scanner_rays

SAME = 1e-3  # pixels by which a pose may miss a circle and still be one


def circle_of(rays: Rays, nDetector) -> dict | None:
    """DSO, DSD, dDetector, offDetector and angles of the circle that the poses are, None where they are none."""
    out = -rays.source if rays.parallel else rays.source
    angles = np.arctan2(out[:, 1], out[:, 0])
    c, s = np.cos(angles), np.sin(angles)
    centre = rays.centre(nDetector)
    DSO = 0.0 if rays.parallel else float(np.mean(np.hypot(out[:, 0], out[:, 1])))
    circle = dict(
        DSO=DSO,
        DSD=float(DSO - np.mean(centre[:, 0] * c + centre[:, 1] * s)),
        angles=angles,
        dDetector=tuple(float(np.mean(np.linalg.norm(x, axis=1))) for x in (rays.v, rays.u)),
        offDetector=(float(np.mean(centre[:, 2])), float(np.mean(centre[:, 1] * c - centre[:, 0] * s))),
    )
    if not rays.parallel and not circle['DSD'] >= DSO > 0:
        return None
    like = scanner_rays(
        circle['angles'], DSO, circle['DSD'], nDetector, circle['dDetector'], rays.parallel, circle['offDetector']
    )
    # A beam's direction moves what it meets at a distance.
    reach = np.linalg.norm(rays.corner, axis=1).max() if rays.parallel else 1
    allowed = SAME * min(circle['dDetector'])
    near = all(
        np.abs(a - b).max() * size <= allowed
        for a, b, size in (
            (rays.source, like.source, reach),
            (rays.corner, like.corner, 1),
            (rays.u, like.u, nDetector[1]),
            (rays.v, like.v, nDetector[0]),
        )
    )
    return circle if near else None
