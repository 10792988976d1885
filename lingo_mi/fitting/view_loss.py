"""One measured view in a step of the fit: the cloud's image, the loss and its derivatives."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting.measured import weights_of
from lingo_mi.fitting.models.forward import ForwardModel
from lingo_mi.fitting.options.loss import ImageLoss
from lingo_mi.lingo.loss_scale import loss_scale
from lingo_mi.projectors.backprop import Cuts, leaves
from lingo_mi.projectors.bent import Bend
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.replay import Replay
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import View
from lingo_mi.scan import Scan


@dataclass
class MeasuredView:
    """A measured view on the device.

    Parameters
    ----------
    view : View
        Its rays.
    pixels : Float [height * width]
        Normalised line integrals over the fit's unit of density.
    weights : Float
        Factor applied to `pixels` and to rendered images before comparison; None: 1.
    valid : Bool
        Which pixels are valid; None: all.
    rays
        The geometry's `Rays` of this view alone.
    scattered : Float
        Expected scattered light in the pixels; None: none.
    """

    view: View
    pixels: Any
    weights: Any = None
    valid: Any = None
    rays: Any = None
    scattered: Any = None

    @staticmethod
    def of(scan: Scan, index: int, unit: float, weights: np.ndarray | None = None) -> MeasuredView:
        """View `index` of a scan; weights float32 [view, v, u] or None."""
        height, width = scan.geometry.nDetector
        rays = scan.geometry.normalised_rays(curved=True)[[index]]
        pixels = scan.projections[index].ravel() * np.float32(scan.geometry.grid.scale / unit)
        valid = on_device = None
        if weights is not None:
            pixel_weights = weights[index].ravel()
            pixels, on_device = pixels * pixel_weights, uploaded(pixel_weights)
        if scan.valid is not None and not scan.valid[index].all():
            valid = mi.Bool(scan.valid[index].ravel())
            dr.make_opaque(valid)
        return MeasuredView(View.of(rays, 0, height, width), uploaded(pixels), on_device, valid, rays)

    def masked(self, image: Any) -> Any:
        """The image prepared for comparison: weighted, invalid pixels zero (as in `pixels`).

        SSIM treats invalid pixels like the outside of the panel. Their derivatives vanish.
        """
        if self.weights is not None:
            image = image * self.weights
        return image if self.valid is None else dr.select(self.valid, image, 0)


def targets_of(scan: Scan, unit: float, weights: str = 'equal') -> list[MeasuredView]:
    """All views of a scan. unit: of density; weights: as for `ImageLoss`."""
    factors = weights_of(scan, weights)
    return [MeasuredView.of(scan, i, unit, factors) for i in range(len(scan))]


def differentiate(
    gaussians: tuple,
    target: MeasuredView,
    loss: ImageLoss,
    forward: ForwardModel,
    batch: int,
    signal: Any = None,
    share: Any = None,
) -> tuple[Any, Any, Any, Any]:
    """Add the gradient of one view's loss to the gradient of the Gaussians (with gradients enabled).

    Parameters
    ----------
    loss : ImageLoss
        What is compared, and how.
    forward : ForwardModel
        The model of the Gaussians.
    batch : int
        Views per step; the loss is their mean.
    signal
        `ExpectedSignal` of the detector; None: line integrals.
    share
        Share of the second of two materials in every Gaussian, Float [N]; None: one material.

    Returns
    -------
    tuple[Any, Any, Any, Any]
        Four values:

        1. the view's part of the loss, Float [1], not multiplied by the loss scale
        2. the norm of the gradient with respect to each projected centre, Float [N], for densification
        3. 1 for each Gaussian that is visible, else 0, Float [N], for densification
        4. the view's part of the loss scale, Float [1]; None without one
    """
    view = target.view
    bundles = []  # of rays: one, or several if the signal is a mean over them

    def image_along(rays):
        cut = Cuts()
        footprints = forward.footprints(gaussians, rays, cut)
        leaf = leaves(footprints.values)  # their derivatives make the statistic
        bundles.append((footprints, leaf, cut))
        return forward.integrals(replace(footprints, values=leaf), rays, share)

    image = image_along(view)[0] if signal is None else signal.image(image_along, view, target.scattered)
    compared = target.masked(image), target.pixels, view.height, view.width
    value = loss.value(*compared)
    factor = loss_scale(dr.detach(image)) if loss.loss_scale != 'none' else mi.Float(1)
    weight = (factor if loss.loss_scale == 'dynamic' else mi.Float(1)) * (1 / batch)
    # Bundles share the graph from the pose, so its edges must be kept until the last bundle.
    flags = dr.ADFlag.Default if len(bundles) == 1 else dr.ADFlag.ClearVertices
    dr.backward(value * weight, flags=flags)
    # Outside `suspend_grad`, where gradients read as zero.
    gx, gy = functools.reduce(_sum, [(dr.grad(leaf[-2]), dr.grad(leaf[-1])) for _, leaf, _ in bundles])
    footprints = bundles[len(bundles) // 2][0]
    with dr.suspend_grad():
        across, down = (view.width, view.height) if view.bend is None else (view.height, view.width)
        norm = dr.norm(mi.Vector2f(gx * (across / 2), gy * (down / 2))) * batch
        norm = norm * factor if loss.loss_scale == 'statistic' else norm
        visible = dr.select(footprints.visible, mi.Float(1), 0)
    for footprints, leaf, cut in bundles:  # one by one: a single kernel for all would take long to compile
        with full_float64():
            cut.pass_on(footprints.values, map(dr.grad, leaf), flags)
        evaluate((*gaussians, view.source, view.corner, view.u, view.v))
    return dr.detach(value) * (1 / batch), norm, visible, weight if loss.loss_scale == 'dynamic' else None


def _sum(a, b):
    total = a[0] + b[0], a[1] + b[1]
    dr.eval(total)  # one by one, for the same reason as bundles
    return total


def differentiate_replayed(
    gaussians: tuple, target: MeasuredView, loss: ImageLoss, forward: ForwardModel, batch: int
) -> list:
    """`differentiate` for plain line integrals, replayed from a recording. The view's pose is constant."""
    view = target.view
    *results, gradients = _REPLAY(
        *gaussians,
        view.source,
        view.corner,
        view.u,
        view.v,
        None if view.bend is None else view.bend.table,
        None if view.bend is None else view.bend.numbers,
        target.pixels,
        target.weights,
        target.valid,
        height=view.height,
        width=view.width,
        parallel=view.parallel,
        loss=loss,
        forward=forward,
        batch=batch,
    )
    for x, gradient in zip(gaussians, gradients):
        dr.accum_grad(x, gradient)
    return results


def _differentiated(*arrays, height, width, parallel, loss, forward, batch):
    *gaussians, source, corner, u, v, table, numbers, pixels, weights, valid = arrays
    dr.enable_grad(gaussians)
    bend = None if table is None else Bend(table, numbers)
    target = MeasuredView(View(source, corner, u, v, width, height, parallel, bend), pixels, weights, valid)
    return *differentiate(tuple(gaussians), target, loss, forward, batch), [dr.grad(x) for x in gaussians]


_REPLAY = Replay(_differentiated)


def evaluate(values: Iterable) -> None:
    """Evaluate all derivatives in one kernel: separate kernels would repeat their common work."""
    dr.eval([dr.grad(value) for value in values])
