"""Radiance of Gaussians towards a view, for alpha compositing."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.view import View


def radiance_towards(centre: Any, view: View, radiance: Any, harmonics: Any = None) -> Any:
    """Radiance of N Gaussians along the rays of a view, Float [N]. Differentiable in all inputs, including the view's pose.

    With harmonics, the radiance is max(0, 1/2 + sum of coefficient x harmonic) in the direction from source to centre;
    `radiance` is the coefficient of degree 0 (Kerbl et al., ACM TOG 42, 2023, and the released code). Without, it is a sigmoid
    of `radiance`. (Cai et al., X-Gaussian, ECCV 2024, has 1/2 plus a weighted sum of 16 numbers. For grey images one number
    expresses the same, but Adam, which moves every number equally far, moves their sum about 3.6 times as fast.)

    Parameters
    ----------
    centre : Point3f [N]
    radiance : Float [N]
        Raw.
    harmonics
        ArrayXf [3, 8 or 15, N]: coefficients of the spherical harmonics of degrees 1 to 3; None: the same radiance in all
        directions.
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
