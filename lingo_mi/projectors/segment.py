r"""Line integrals of single Gaussians along ray segments, pixel by pixel, for Gaussians without a footprint.

If the source is inside or near a Gaussian, or the Gaussian straddles the plane of the source, its footprint is not an ellipse.
The integral must then begin where the ray o + tD does, at t = 0:

.. math::  \rho \frac{|D|}{|d|} \sqrt{\pi/2} \, e^{-\frac12 |w \times d|^2 / |d|^2}
           \left[ 1 + \mathrm{erf}(m |d| / \sqrt2) \right], \quad m = w \cdot d / |d|^2

All in float64: these Gaussians are few, and each takes a pass over the image anyway.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.rotation import rotate_inverse, rows_of
from lingo_mi.projectors.view import View


def add_straddling(image: Any, gaussians: tuple, view: View, indices: Any) -> Any:
    """Add the Gaussians at `indices`, UInt32, to a cone-beam image, Float [height * width]. Differentiable.

    Parameters
    ----------
    gaussians : tuple
        Centres, scales, rotations and densities, as for `footprint.project`.
    """
    for k in range(dr.width(indices)):
        i = dr.gather(mi.UInt32, indices, dr.opaque(mi.UInt32, k))
        gaussian = [dr.gather(type(x), x, i) for x in gaussians]
        image += _integrate(*gaussian, view=view)
        dr.eval(image)
    return image


@full_float64()
def _integrate(centre: Any, scale: Any, rotation: Any, density: Any, view: View) -> Any:
    Vector3d = mi.Vector3d
    Float64: Any = dr.value_t(Vector3d)
    p, s, rho = Vector3d(centre), Vector3d(scale), Float64(density)
    Vector4d: Any = dr.float64_array_t(type(rotation))
    rows = rows_of(Vector4d(rotation), Vector3d)
    i = dr.arange(mi.UInt32, view.height * view.width)
    width = dr.opaque(mi.UInt32, view.width)
    x, y = Float64(i % width) + 0.5, Float64(i // width) + 0.5
    if view.bend is not None:
        x, y = view.bend.on_plane(i % width, i // width)
    D = view.corner - view.source + x * view.u + y * view.v
    w, d = rotate_inverse(rows, p - view.source) / s, rotate_inverse(rows, D) / s
    dd = dr.squared_norm(d)
    length = dr.sqrt(dd)
    middle = dr.dot(w, d) / dd
    peak = rho * dr.norm(D) / length * dr.exp(-0.5 * dr.squared_norm(dr.cross(w, d)) / dd)
    return mi.Float(1.2533141373155001 * peak * (1 + dr.erf(middle * length * 0.7071067811865476)))
