"""Line integrals of a cloud of Gaussians: the splat, and the general form for the few that it cannot express."""

from __future__ import annotations

import warnings
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from lingo_mi.errors import AccuracyWarning, InputError
from lingo_mi.projectors.backprop import leaves, pass_on
from lingo_mi.projectors.depth import deepest, parts_of
from lingo_mi.projectors.footprint import NAMES, project
from lingo_mi.projectors.frozen import Replay
from lingo_mi.projectors.segment import add_straddling
from lingo_mi.projectors.splat import Plan, by_values, prepare, splat
from lingo_mi.projectors.view import View

DENOMINATOR = 'e1', 'e2', 'e11', 'e12', 'e22'  # a footprint's numbers for how |d|^2 varies over it
POSE = 4  # arrays at the end of the inputs: source, corner, u, v
PIXEL_VARIANCE = 1 / 12  # of a square of side 1, along either side


def columns(rows):
    """Centres Point3f, scales Vector3f and rotations Vector4f [N] of `ellipsoids`, from its rows of ten numbers, Float [10 N]."""
    i = dr.arange(mi.UInt32, dr.width(rows) // 10) * 10
    # Every entry is read once, so the derivative needs no atomics.
    c = [dr.gather(mi.Float, rows, i + j, mode=dr.ReduceMode.Permute) for j in range(10)]
    return mi.Point3f(*c[:3]), mi.Vector3f(*c[3:6]), mi.Vector4f(*c[6:])


def line_integrals(
    centre,
    scale,
    rotation,
    density,
    view,
    extent: float = 4.0,
    primal: bool = True,
    affine: bool = False,
    area: bool = False,
    rows=None,
):
    """Line integrals of every pixel of a view, Float [height * width], row by row, in density times length.

    centre, scale   Point3f, Vector3f [N]; standard deviations
    rotation        Vector4f [N], quaternion (x, y, z, w)
    density         Float [N], value at the centre
    view            `frame.View`
    extent          cut-off in standard deviations
    primal          False where only derivatives are wanted: the image is then left at zero
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
    settings = dict(
        width=view.width,
        height=view.height,
        parallel=view.parallel,
        panel=view.panel,
        extent=extent,
        affine=affine,
        area=area,
    )
    return dr.custom(_LineIntegrals, inputs, tuple(map(dr.grad_enabled, inputs)), settings, primal)


class _LineIntegrals(dr.CustomOp):
    """The splat of what can be splatted, of which all but tangents is replayed, and the rest, one by one.

    In how many parts to add up and what the rest is, the host learns from the footprints, before the splat is launched: it then
    goes on while the device adds up pixels.
    """

    def eval(self, inputs, wanted, settings, primal):
        self.inputs, self.wanted, self.settings, self.parts, self.known = inputs, wanted, settings, 1, None
        if not primal:
            return dr.zeros(mi.Float, settings['width'] * settings['height'])
        prepared, straddling = self._look()
        if (settings['affine'] or settings['area']) and dr.width(straddling):
            warnings.warn(
                AccuracyWarning(
                    f'{dr.width(straddling)} Gaussians reach to the source or the panel: of them the integral along the ray through '
                    f'the pixel\'s centre is taken, whatever "pixel" and "footprint" say'
                ),
                stacklevel=4,
            )
        image = _DRAW(*prepared, *inputs[-POSE:], parts=self.parts, **settings)
        if any(wanted):
            self.known = prepared, straddling
        return _with_rest(image, inputs, settings, straddling)

    def forward(self):
        leaf = leaves(self.inputs)
        dr.set_grad(leaf, self.grad_in('inputs'))
        view, footprints = _footprints(*leaf, **self.settings)
        image = splat(footprints, view.height, view.width, self.settings['extent'], self.parts) * view.lengths()
        image = _with_rest(image, leaf, self.settings, dr.compress(footprints.straddles))
        dr.forward_to(image)
        self.set_grad_out(dr.grad(image))

    def backward(self):
        of_pose = any(self.wanted[-POSE:])  # which changes what the splat's image is multiplied by, too
        prepared, straddling = self.known or self._look(deep=of_pose)
        self.known, upstream = None, self.grad_out()
        found = _GATHER(*prepared, *self.inputs[-POSE:], upstream, image=of_pose, parts=self.parts, **self.settings)
        del prepared  # as large as all that follows
        gradients = _CHAIN(*self.inputs, *found, wanted=self.wanted, **self.settings)
        if dr.width(straddling) and not self.settings['parallel']:
            leaf = leaves(self.inputs)
            dr.backward_from(_with_rest(mi.Float(0), leaf, self.settings, straddling) * upstream)
            gradients = [a + dr.grad(b) for a, b in zip(gradients, leaf)]
        self.set_grad_in('inputs', tuple(gradients))

    def name(self):
        return 'line integrals'

    def _look(self, deep=True):
        """What `splat.Plan` takes, and the indices of what cannot be splatted; with `deep`, finds in how many parts to add up.
        Waits for the device."""
        *prepared, straddles, depth = _PREPARE(*self.inputs, **self.settings, deep=deep)
        if deep:
            self.parts = parts_of(depth)
        return prepared, dr.compress(straddles)


def _read(*inputs, width, height, parallel, panel, **_):
    """Centres, scales, rotations and densities, and the view, that the inputs are."""
    *shapes, density = inputs[:-POSE]
    shapes = columns(*shapes) if len(shapes) == 1 else shapes
    return (*shapes, density), View(*inputs[-POSE:], width, height, parallel, panel)


def _footprints(*inputs, extent, affine, area, **of_view):
    gaussians, view = _read(*inputs, **of_view)
    footprints = project(*gaussians, view, extent, PIXEL_VARIANCE if area else 0.0)
    return view, _affine(footprints) if affine else footprints


def _with_rest(image, inputs, settings, indices):
    """An image with the Gaussians of some indices, which cannot be splatted; in a parallel beam nothing can integrate them."""
    if dr.width(indices) == 0:
        return image
    gaussians, view = _read(*inputs, **settings)
    return image + dr.nan if view.parallel else add_straddling(image, *gaussians, view, indices)


def _prepare(*inputs, deep, **settings):
    """What `splat.Plan` takes, then which Gaussians cannot be splatted, Bool [N], and how deep they lie."""
    view, f = _footprints(*inputs, **settings)
    found = prepare(f.values, replace(f, values=()))
    return *found, f.straddles, deepest((f.column, f.row), f.area, (view.width, view.height)) if deep else None


def _draw(*arrays, width, height, parallel, panel, extent, parts, **_):
    view = View(*arrays[-POSE:], width, height, parallel, panel)
    return Plan(arrays[:-POSE], height, width, extent).image(parts) * view.lengths()


def _gather(*arrays, width, height, parallel, panel, extent, image, parts, **_):
    """What `Plan.gradient` gives, then the derivative by the rays' lengths, Float [pixels], where the `image` is wanted for it."""
    *prepared, source, corner, u, v, upstream = arrays
    plan = Plan(prepared, height, width, extent)
    lengths = View(source, corner, u, v, width, height, parallel, panel).lengths()
    return *plan.gradient(upstream * lengths), plan.image(parts) * upstream if image else None


def _chain(*arrays, wanted, **settings):
    inputs, (*found, by_lengths) = arrays[: len(wanted)], arrays[len(wanted) :]
    dr.enable_grad([x for x, w in zip(inputs, wanted) if w])
    view, footprints = _footprints(*inputs, **settings)
    ends, gradients = list(footprints.values), list(by_values(found, dr.detach(footprints.values[3])))
    if by_lengths is not None:
        ends, gradients = [*ends, view.lengths()], [*gradients, by_lengths]
    pass_on(ends, gradients)
    return [dr.grad(x) for x in inputs]


_PREPARE, _DRAW, _GATHER, _CHAIN = map(Replay, (_prepare, _draw, _gather, _chain))


def _affine(footprints):
    """Footprints whose denominators are 1; opaque zeros, so that the kernels are those of the exact model."""
    zero = dr.opaque(mi.Float, 0, dr.width(footprints.column))
    values = (zero if name in DENOMINATOR else value for name, value in zip(NAMES, footprints.values))
    return replace(footprints, values=tuple(values))
