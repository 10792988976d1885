"""Line integrals of a cloud of Gaussians: the splat, and the general form for the few that it cannot express."""
from __future__ import annotations

import warnings
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..errors import AccuracyWarning
from .footprint import NAMES, project
from .segment import add_straddling
from .splat import splat


DENOMINATOR = 'e1', 'e2', 'e11', 'e12', 'e22'   # a footprint's numbers for how |d|^2 varies over it
PIXEL_VARIANCE = 1 / 12  # of a square of side 1, along either side


def line_integrals(centre, scale, rotation, density, view, extent: float = 4., primal: bool = True,
                   affine: bool = False, area: bool = False):
    """Line integrals of every pixel of a view, Float [height * width], row by row, in density times length.

    centre, scale   Point3f, Vector3f [N]; standard deviations
    rotation        Vector4f [N], quaternion (x, y, z, w)
    density         Float [N], value at the centre
    view            `frame.View`
    extent          cut-off in standard deviations
    primal          False where only derivatives are wanted: the splatted part of the image is then left at zero
    affine          the model of Gaussian splatting (EWA): |d|^2 frozen at each Gaussian's centre
    area            the mean over each pixel's area instead of the ray through its centre: the footprint convolved with a
                    Gaussian of the pixel's variance

    Differentiable in all four and in the view's pose, in forward and reverse mode. A Gaussian that is not finite, has
    no extent or no rotation leaves no finite pixel.
    """
    footprints = project(centre, scale, rotation, density, view, extent, PIXEL_VARIANCE if area else 0.)
    if affine:
        footprints = _frozen(footprints)
    image = splat(footprints, view.height, view.width, extent, primal, deep=True) * view.lengths()
    if view.parallel:
        return image + dr.sum(dr.select(footprints.straddles, dr.nan, mi.Float(0)))
    straddling = dr.compress(footprints.straddles)  # waits for the device
    if (affine or area) and dr.width(straddling):
        warnings.warn(AccuracyWarning(
            f'{dr.width(straddling)} Gaussians reach to the source or the panel: of them the integral along the ray through '
            f'the pixel\'s centre is taken, whatever "pixel" and "footprint" say'), stacklevel=3)
    return add_straddling(image, centre, scale, rotation, density, view, straddling)


def _frozen(footprints):
    """Footprints whose denominators are 1; opaque zeros, so that the kernels are those of the exact model."""
    zero = dr.opaque(mi.Float, 0, dr.width(footprints.column))
    values = (zero if name in DENOMINATOR else value for name, value in zip(NAMES, footprints.values))
    return replace(footprints, values=tuple(values))
