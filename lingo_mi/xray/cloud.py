"""Line integrals of a cloud of Gaussians: the splat, and the general form for the few that it cannot express."""
from __future__ import annotations

import warnings
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..errors import AccuracyWarning, InputError
from .depth import deepest, parts_of
from .footprint import NAMES, project
from .frame import View
from .replay import Replay
from .segment import add_straddling
from .splat import splat


DENOMINATOR = 'e1', 'e2', 'e11', 'e12', 'e22'   # a footprint's numbers for how |d|^2 varies over it
POSE = 4                 # arrays at the end of the inputs: source, corner, u, v
PIXEL_VARIANCE = 1 / 12  # of a square of side 1, along either side


def columns(rows):
    """Centres Point3f, scales Vector3f and rotations Vector4f [N] of `ellipsoids`, from its rows of ten numbers, Float [10 N]."""
    i = dr.arange(mi.UInt32, dr.width(rows) // 10) * 10
    # Every entry is read once, so the derivative needs no atomics.
    c = [dr.gather(mi.Float, rows, i + j, mode=dr.ReduceMode.Permute) for j in range(10)]
    return mi.Point3f(*c[:3]), mi.Vector3f(*c[3:6]), mi.Vector4f(*c[6:])


def line_integrals(centre, scale, rotation, density, view, extent: float = 4., primal: bool = True,
                   affine: bool = False, area: bool = False, rows=None):
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
    rows            Float [10 N], what the first three are the `columns` of, if that is so; saves a copy of them

    Differentiable in all four and in the view's pose, in forward and reverse mode. A Gaussian that is not finite, has
    no extent or no rotation leaves no finite pixel. Raises InputError for an empty cloud.
    """
    if dr.width(density) == 0:
        raise InputError('the cloud is empty: it needs at least one Gaussian')
    gaussians = (centre, scale, rotation, density) if rows is None else (rows, density)
    inputs = *gaussians, view.source, view.corner, view.u, view.v
    settings = dict(width=view.width, height=view.height, parallel=view.parallel, panel=view.panel, extent=extent,
                    affine=affine, area=area)
    image, straddles = dr.custom(_Splatted, inputs, tuple(map(dr.grad_enabled, inputs)), settings, primal)
    if view.parallel:
        return image + dr.sum(dr.select(straddles, dr.nan, mi.Float(0)))
    straddling = dr.compress(straddles)  # waits for the device
    if (affine or area) and dr.width(straddling):
        warnings.warn(AccuracyWarning(
            f'{dr.width(straddling)} Gaussians reach to the source or the panel: of them the integral along the ray through '
            f'the pixel\'s centre is taken, whatever "pixel" and "footprint" say'), stacklevel=3)
    return add_straddling(image, centre, scale, rotation, density, view, straddling)


class _Splatted(dr.CustomOp):
    """The image of what can be splatted, and which Gaussians cannot, Bool [N]. All but tangents is replayed."""

    def eval(self, inputs, wanted, settings, primal):
        self.inputs, self.wanted, self.settings, self.parts = inputs, wanted, settings, 1
        if not primal:
            return dr.zeros(mi.Float, settings['width'] * settings['height']), _STRADDLES(*inputs, **settings)
        image, straddles, depth = _PRIMAL(*inputs, **settings)
        self.parts = parts_of(depth)
        if self.parts > 1:
            image, _ = _image(*inputs, **settings, parts=self.parts)
        return image, straddles

    def forward(self):
        leaves = tuple(dr.detach(x) for x in self.inputs)
        dr.enable_grad(leaves)
        dr.set_grad(leaves, self.grad_in('inputs'))
        image, footprints = _image(*leaves, **self.settings, parts=self.parts)
        dr.forward_to(image)
        self.set_grad_out((dr.grad(image), footprints.straddles))  # the latter has no tangent, and keeps its place

    def backward(self):
        self.set_grad_in('inputs', _GRADIENT(*self.inputs, self.grad_out()[0], wanted=self.wanted, parts=self.parts,
                                             **self.settings))

    def name(self):
        return 'line integrals'


def _footprints(*inputs, width, height, parallel, panel, extent, affine, area):
    *shapes, density = inputs[:-POSE]
    view = View(*inputs[-POSE:], width, height, parallel, panel)
    shapes = columns(*shapes) if len(shapes) == 1 else shapes
    footprints = project(*shapes, density, view, extent, PIXEL_VARIANCE if area else 0.)
    return view, _affine(footprints) if affine else footprints


def _image(*inputs, primal=True, parts=1, **settings):
    view, footprints = _footprints(*inputs, **settings)
    return splat(footprints, view.height, view.width, settings['extent'], primal, parts) * view.lengths(), footprints


def _primal(*inputs, width, height, **settings):
    image, f = _image(*inputs, width=width, height=height, **settings)
    return image, f.straddles, deepest((f.column, f.row), f.area, (width, height))


def _gradient(*inputs, wanted, parts, **settings):
    *inputs, upstream = inputs
    dr.enable_grad([x for x, w in zip(inputs, wanted) if w])
    of_pose = any(wanted[-POSE:])  # which changes what the splat's image is multiplied by, too
    dr.backward_from(_image(*inputs, primal=of_pose, parts=parts, **settings)[0] * upstream)
    return tuple(dr.grad(x) for x in inputs)


_PRIMAL, _GRADIENT = Replay(_primal), Replay(_gradient)
_STRADDLES = Replay(lambda *inputs, **settings: _footprints(*inputs, **settings)[1].straddles)


def _affine(footprints):
    """Footprints whose denominators are 1; opaque zeros, so that the kernels are those of the exact model."""
    zero = dr.opaque(mi.Float, 0, dr.width(footprints.column))
    values = (zero if name in DENOMINATOR else value for name, value in zip(NAMES, footprints.values))
    return replace(footprints, values=tuple(values))
