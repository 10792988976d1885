"""Line integrals of a cloud of Gaussians: the splat, and the general form for the few that it cannot express."""
from __future__ import annotations

from .footprint import project
from .segment import add_straddling
from .splat import splat


def line_integrals(centre, scale, rotation, density, view, extent: float = 4., primal: bool = True):
    """Line integrals of every pixel of a view, Float [height * width], row by row, in density times length.

    centre, scale   Point3f, Vector3f [N]; standard deviations
    rotation        Vector4f [N], quaternion (x, y, z, w)
    density         Float [N], value at the centre
    view            `frame.View`
    extent          cut-off in standard deviations
    primal          False where only derivatives are wanted: the splatted part of the image is then left at zero

    Differentiable in all four and in the view's pose, in forward and reverse mode.
    """
    footprints = project(centre, scale, rotation, density, view, extent)
    image = splat(footprints, view.height, view.width, extent, primal) * view.lengths()
    if view.parallel:
        return image
    return add_straddling(image, centre, scale, rotation, density, view, footprints.straddles)
