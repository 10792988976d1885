"""Line integrals of a cloud of Gaussians: the splat, and a general integral for the few that have no footprint."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.errors import AccuracyWarning, InputError
from lingo_mi.projectors.backprop import Cuts, leaves
from lingo_mi.projectors.bent import Bend
from lingo_mi.projectors.depth import deepest, parts_of
from lingo_mi.projectors.footprint import NAMES, project
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.replay import Replay
from lingo_mi.projectors.segment import add_straddling
from lingo_mi.projectors.splat import Plan, by_values, prepare, splat
from lingo_mi.projectors.view import View

DENOMINATOR = 'e1', 'e2', 'e11', 'e12', 'e22'  # numbers that say how |d|^2 varies over a footprint
POSE = 4  # arrays at the end of the inputs: source, corner, u, v
_NO_BEND = None, None
PIXEL_VARIANCE = 1 / 12  # of a unit square, along each axis


def columns(rows: Any) -> tuple[Any, Any, Any]:
    """Centres Point3f, scales Vector3f and rotations Vector4f [N] of `ellipsoids`, from its rows of ten numbers, Float [10 N]."""
    i = dr.arange(mi.UInt32, dr.width(rows) // 10) * 10
    # Every entry is read once, so the derivative needs no atomics.
    c = [dr.gather(mi.Float, rows, i + j, mode=dr.ReduceMode.Permute) for j in range(10)]
    return mi.Point3f(*c[:3]), mi.Vector3f(*c[3:6]), mi.Vector4f(*c[6:])


def line_integrals(
    centre: Any, scale: Any, rotation: Any, density: Any, view: View, options: RenderOptions, primal: bool = True
) -> Any:
    """Line integrals of every pixel of a view, Float [height * width], row by row, in density times length.

    Differentiable in all four and in the view's pose, in forward and reverse mode. A Gaussian that is not finite, has no extent
    or no rotation leaves no finite pixel.

    Parameters
    ----------
    centre, scale : Point3f, Vector3f [N]
        Standard deviations.
    rotation : Vector4f [N]
        Quaternion (x, y, z, w).
    density : Float [N]
        Value at the centre.
    view : View
        Its pixels: one ray each, or the mean over the pixel (`options.area`); for more rays `options.subdivided`.
    options : RenderOptions
        Cut-off, footprint, area and sharing.
    primal : bool
        False if only derivatives are needed: the image is then zero.

    Raises
    ------
    InputError
        For an empty cloud.
    """
    return _of_inputs((centre, scale, rotation, density), view, options, primal)


def line_integrals_of_rows(rows: Any, density: Any, view: View, options: RenderOptions, primal: bool = True) -> Any:
    """`line_integrals` from rows of ten numbers, Float [10 N]: centre, scale, rotation (see `columns`). Saves a copy."""
    return _of_inputs((rows, density), view, options, primal)


def _of_inputs(gaussians, view, options, primal):
    if dr.width(gaussians[-1]) == 0:
        raise InputError('the cloud is empty: it needs at least one Gaussian')
    inputs = *gaussians, view.source, view.corner, view.u, view.v
    settings = dict(panel=_Panel(view.width, view.height, view.parallel), options=options)
    if view.bend is not None and (options.area or options.footprint != 'exact'):
        raise InputError("a curved panel needs the exact footprint of rays: leave out footprint and pixel='area'")
    bend = _NO_BEND if view.bend is None else (view.bend.table, view.bend.numbers)
    return dr.custom(_LineIntegrals, inputs, tuple(map(dr.grad_enabled, inputs)), settings, primal, bend)


@dataclass(frozen=True)
class _Panel:
    """The constants of a view in a recording: all fields of `View` but the pose."""

    width: int
    height: int
    parallel: bool

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def view(self, pose: Sequence, bend: tuple) -> View:
        bent = None if bend[0] is None else Bend(*bend)
        return View(*pose, width=self.width, height=self.height, parallel=self.parallel, bend=bent)


class _LineIntegrals(dr.CustomOp):
    """Splats all Gaussians that have a footprint and integrates the others one by one.

    All but forward-mode derivatives is replayed. The footprints tell the host, before the splat starts, how many partial sums
    are needed and which Gaussians are left over. The host then goes on while the device adds up pixels.
    """

    def eval(self, inputs, wanted, settings, primal, bend):
        self.inputs, self.wanted, self.settings, self.parts, self.prepared = inputs, wanted, settings, 1, None
        self.bend = bend
        if not primal:
            return dr.zeros(mi.Float, settings['panel'].pixels)
        prepared, straddling = self._prepared_arrays()
        options = settings['options']
        if (options.footprint == 'affine' or options.area) and dr.width(straddling):
            warnings.warn(
                AccuracyWarning(
                    f'{dr.width(straddling)} Gaussians reach to the source, or lie along rays: for them the '
                    f'integral along the ray through the pixel\'s centre is taken, whatever "pixel" and "footprint" say'
                ),
                stacklevel=5,
            )
        image = _DRAW(*bend, *prepared, *inputs[-POSE:], parts=self.parts, **settings)
        if any(wanted):
            self.prepared = prepared, straddling
        return _with_rest(image, inputs, bend, settings, straddling)

    def forward(self):
        leaf = leaves(self.inputs)
        dr.set_grad(leaf, self.grad_in('inputs'))
        view, footprints = _footprints(*self.bend, *leaf, **self.settings)
        options = self.settings['options']
        image = splat(footprints, view.height, view.width, options.extent, self.parts, options.sharing) * view.lengths()
        image = _with_rest(image, leaf, self.bend, self.settings, dr.compress(footprints.straddles))
        dr.forward_to(image)
        self.set_grad_out(dr.grad(image))

    def backward(self):
        of_pose = any(self.wanted[-POSE:])  # the pose also changes the rays' lengths, which multiply the image
        prepared, straddling = self.prepared or self._prepared_arrays(deep=of_pose)
        self.prepared = None
        upstream: Any = self.grad_out()
        derivatives = _GATHER(
            *self.bend, *prepared, *self.inputs[-POSE:], upstream, image=of_pose, parts=self.parts, **self.settings
        )
        del prepared  # frees memory: as large as all that follows
        gradients = _BY_INPUTS(*self.bend, *self.inputs, *derivatives, wanted=self.wanted, **self.settings)
        if dr.width(straddling) and not self.settings['panel'].parallel:
            leaf = leaves(self.inputs)
            dr.backward_from(_with_rest(mi.Float(0), leaf, self.bend, self.settings, straddling) * upstream)
            gradients = [a + dr.grad(b) for a, b in zip(gradients, leaf)]
        self.set_grad_in('inputs', tuple(gradients))

    def name(self):
        return 'line integrals'

    def _prepared_arrays(self, deep=True):
        """The arrays for `splat.Plan`, and the indices of Gaussians that cannot be splatted. With `deep`, also sets the number
        of partial sums. Waits for the device."""
        *prepared, straddles, depth = _PREPARE(*self.bend, *self.inputs, **self.settings, deep=deep)
        if deep:
            self.parts = parts_of(depth)
        return prepared, dr.compress(straddles)


def _read(*arrays, panel, **_) -> tuple[tuple[Any, ...], View]:
    """The bend and the inputs as (centres, scales, rotations, densities) and the view."""
    bend, inputs = arrays[:2], arrays[2:]
    *shapes, density = inputs[:-POSE]
    shapes = columns(*shapes) if len(shapes) == 1 else shapes
    return (*shapes, density), panel.view(inputs[-POSE:], bend)


def _footprints(*arrays, panel, options, cut=None):
    gaussians, view = _read(*arrays, panel=panel)
    widen = PIXEL_VARIANCE if options.area else 0.0
    footprints = project(gaussians, view, options.extent, widen, cut)
    return view, _affine(footprints) if options.footprint == 'affine' else footprints


def _with_rest(image, inputs, bend, settings, indices):
    """The image plus the Gaussians at `indices`, which cannot be splatted. In a parallel beam these are invalid: NaN."""
    if dr.width(indices) == 0:
        return image
    gaussians, view = _read(*bend, *inputs, **settings)
    return image + dr.nan if view.parallel else add_straddling(image, gaussians, view, indices)


def _prepare(*arrays, deep, panel, options):
    """The arrays for `splat.Plan`; which Gaussians cannot be splatted, Bool [N]; the overlap depth if `deep`, else None."""
    view, f = _footprints(*arrays, panel=panel, options=options)
    prepared = prepare(f.values, replace(f, values=()), options.sharing)
    shape = (view.width, view.height) if view.bend is None else (view.height, view.width)
    return *prepared, f.straddles, deepest((f.column, f.row), f.area, shape) if deep else None


def _plan(prepared, view, options):
    return Plan(prepared, view.height, view.width, options.extent, options.sharing, view.bend)


def _draw(*arrays, panel, options, parts):
    view = panel.view(arrays[-POSE:], arrays[:2])
    return _plan(arrays[2:-POSE], view, options).image(parts) * view.lengths()


def _gather(*arrays, panel, options, image, parts):
    """The result of `Plan.gradient`; then, if `image`, the derivative by the rays' lengths, Float [pixels]; else None."""
    *prepared, source, corner, u, v, upstream = arrays[2:]
    view = panel.view((source, corner, u, v), arrays[:2])
    plan, lengths = _plan(prepared, view, options), view.lengths()
    return *plan.gradient(upstream * lengths), plan.image(parts) * upstream if image else None


@full_float64()
def _by_inputs(*arrays, wanted, **settings):
    """Derivatives by the inputs. `arrays`: the bend, the inputs, then the result of `_gather`."""
    bend, arrays = arrays[:2], arrays[2:]
    inputs, (*derivatives, by_lengths) = arrays[: len(wanted)], arrays[len(wanted) :]
    dr.enable_grad([x for x, w in zip(inputs, wanted) if w])
    cut = Cuts()
    view, footprints = _footprints(*bend, *inputs, **settings, cut=cut)
    ends, gradients = list(footprints.values), list(by_values(derivatives, dr.detach(footprints.values[3])))
    if by_lengths is not None:
        ends, gradients = [*ends, view.lengths()], [*gradients, by_lengths]
    cut.pass_on(ends, gradients)
    return [dr.grad(x) for x in inputs]


_PREPARE, _DRAW, _GATHER, _BY_INPUTS = map(Replay, (_prepare, _draw, _gather, _by_inputs))


def _affine(footprints):
    """Footprints with denominator 1. The zeros are opaque, so that the exact model's kernels are reused."""
    zero = dr.opaque(mi.Float, 0, dr.width(footprints.column))
    values = (zero if name in DENOMINATOR else value for name, value in zip(NAMES, footprints.values))
    return replace(footprints, values=tuple(values))
