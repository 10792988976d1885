"""Radiance of Gaussians as a view sees it: what alpha compositing composites."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.view import View


def radiance_towards(centre: Any, view: View, radiance: Any, harmonics: Any = None) -> Any:
    """Radiance of N Gaussians along the rays of a view, Float [N]; differentiable in everything, the view's pose included.

    centre      Point3f [N]
    radiance    Float [N], raw
    harmonics   ArrayXf [3, 8 or 15, N]: coefficients of the spherical harmonics of degrees 1 to 3; None for radiance that is
                the same in all directions

    With harmonics, max(0, 1/2 + sum of coefficient x harmonic) in the direction from source to centre, the harmonic of degree
    0 for `radiance` (Kerbl et al., ACM TOG 42, 2023, and the released code). Without, a sigmoid (Cai et al., X-Gaussian, ECCV
    2024, which weighs a vector of features for it: one number does the same for a grey image).
    """
    if harmonics is None:
        return 1 / (1 + dr.exp(-radiance))
    source = mi.Vector3f(view.source)
    direction = dr.normalize(source if view.parallel else mi.Vector3f(centre) - source)
    basis = dr.sh_eval(direction, math.isqrt(len(harmonics) + 1) - 1)
    total = 0.5 + basis[0] * radiance
    for b, coefficient in zip(basis[1:], harmonics):
        total += b * coefficient
    return dr.select(total > 0, total, 0)
