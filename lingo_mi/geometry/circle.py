"""Whether given poses are those of a circular scan."""

from __future__ import annotations

from typing import Any

import numpy as np

from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import scanner_rays

SAME = 1e-3  # pixels by which a pose may miss a circle and still be one


def circle_of(rays: Rays, nDetector: tuple[int, int]) -> dict[str, Any] | None:
    """DSO, DSD, dDetector, offDetector and angles of the circle that the poses are, None where they are none."""
    out = -rays.source if rays.parallel else rays.source
    angles = np.arctan2(out[:, 1], out[:, 0])
    c, s = np.cos(angles), np.sin(angles)
    centre = rays.centre(nDetector)
    DSO = 0.0 if rays.parallel else float(np.mean(np.hypot(out[:, 0], out[:, 1])))
    DSD = float(DSO - np.mean(centre[:, 0] * c + centre[:, 1] * s))
    step_v, step_u = (float(np.mean(np.linalg.norm(x, axis=1))) for x in (rays.v, rays.u))
    offset = (float(np.mean(centre[:, 2])), float(np.mean(centre[:, 1] * c - centre[:, 0] * s)))
    if not rays.parallel and not DSD >= DSO > 0:
        return None
    like = scanner_rays(angles, DSO, DSD, nDetector, (step_v, step_u), rays.parallel, offDetector=offset)
    # A beam's direction moves what it meets at a distance.
    reach = np.linalg.norm(rays.corner, axis=1).max() if rays.parallel else 1
    allowed = SAME * min(step_v, step_u)
    near = all(
        np.abs(a - b).max() * size <= allowed
        for a, b, size in (
            (rays.source, like.source, reach),
            (rays.corner, like.corner, 1),
            (rays.u, like.u, nDetector[1]),
            (rays.v, like.v, nDetector[0]),
        )
    )
    if not near:
        return None
    return dict(DSO=DSO, DSD=DSD, angles=angles, dDetector=(step_v, step_u), offDetector=offset)
