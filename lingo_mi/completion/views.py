"""Completion of a scan: the views to add between the measured ones, rendered from a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.methods.cloud_method import CloudMethod
from lingo_mi.geometry import CircularGeometry, Geometry
from lingo_mi.geometry.trajectories import spread
from lingo_mi.reconstruction.arcs import gaps
from lingo_mi.reconstruction.line_integrals import corrected
from lingo_mi.reconstruction.preconditions import require_pixels
from lingo_mi.scan import Scan
from lingo_mi.scene.checks import check_memory
from lingo_mi.scene.description import MOST_VIEWS

SAME = 1e-9  # share of the scanner's size by which a view may be off one that is turned about z


def fitted_views(scan: Scan, geometry: Geometry) -> Scan:
    """The measured views of a scan that match the views of `geometry` to a hundredth of a pixel, in its order.

    Views are matched by geometry, not by angle: a helix repeats angles at other heights. Among equal views, those that
    `geometry.trajectories.spread` chooses are preferred, then the first unused.

    Raises
    ------
    InputError
        If a view is missing.
    """
    reach = np.linalg.norm(scan.geometry.rays(curved=True).corner, axis=1).max()
    there, wanted = _corners(scan.geometry, reach), _corners(geometry, reach)
    allowed = 0.01 * min(scan.geometry.dDetector)
    missing = InputError(
        f'the fit saw {len(geometry)} views, but not all of them are among the '
        f'{len(scan)} of this scan: give the scan that it was fitted to'
    )
    if len(scan) < len(geometry) or scan.geometry.mode != geometry.mode:
        raise missing
    chosen = spread(len(scan), len(geometry))
    if np.abs(there[chosen] - wanted).max() > allowed:
        left = np.ones(len(scan), bool)
        for i, view in enumerate(wanted):
            same = left & (np.abs(there - view).max(1) <= allowed)
            if not same.any():
                raise missing
            chosen[i] = np.argmax(same)
            left[chosen[i]] = False
    return scan.subset(chosen)


def _corners(geometry: Geometry, reach: float) -> np.ndarray:
    """Points that identify a view, [view, 12] in mm: the source (parallel beam: its direction times `reach`) and three corners
    of the panel."""
    f, (rows, columns) = geometry.rays(curved=True), geometry.nDetector
    source = f.source * reach if f.parallel else f.source
    return np.concatenate([source, f.corner, f.corner + columns * f.u, f.corner + rows * f.v], 1)


def as_corrected(scan: Scan, fit: Fit) -> Scan:
    """The `fitted_views` with the poses that the fit has corrected; unchanged if it has corrected none."""
    if fit.poses is None:
        return scan
    g = scan.geometry
    return replace(scan, geometry=fit.geometry.on(g.grid))


def turns(geometry: Geometry) -> np.ndarray:
    """Angles of the source on its circle about z, radians [view]."""
    if isinstance(geometry, CircularGeometry):
        return geometry.angles
    source = geometry.rays(curved=True).source
    return np.arctan2(source[:, 1], source[:, 0])


def at_turns(geometry: Geometry, angles: np.ndarray) -> Geometry:
    """The same scanner at other angles of its circle about z, radians.

    Raises
    ------
    InputError
        For a scan whose views are not one view turned about z.
    """
    if isinstance(geometry, CircularGeometry):
        return replace(geometry, angles=angles)
    rays, view_turns = geometry.rays(curved=True), turns(geometry)

    def turned(to):
        first = rays[np.zeros(len(to), int)]
        return first.moved(Rotation.from_rotvec(np.outer(to - view_turns[0], [0, 0, 1])).as_matrix())

    if np.abs(turned(view_turns).vectors - rays.vectors).max() > SAME * np.abs(rays.vectors).max():
        raise InputError('the completion of a scan needs a source on a circle about z; this scan has other poses')
    return Geometry.from_poses(turned(angles), geometry.nDetector, grid=geometry.grid)


def missing_angles(geometry: Geometry, views: int) -> np.ndarray:
    """Angles (radians) of the views to add to a geometry's, so that `views` in all are spread as evenly as the given ones allow.

    The widest gap is divided first, until there are enough views. An open arc is not extended, unless one more gap makes it half
    a turn or more: then its last view is taken to be left out, as in half a turn of evenly spaced views.
    """
    angles = turns(geometry)
    order, gap, is_open = gaps(angles, 2 * np.pi)
    if is_open and gap.sum() < np.pi - 1e-3:
        order, gap = order[:-1], gap[:-1]
    parts = np.ones(len(gap), int)
    for _ in range(views - len(angles)):
        parts[np.argmax(gap / parts - 1e-9 * np.arange(len(gap)))] += 1
    return np.concatenate([angles[i] + g * np.arange(1, k) / k for i, g, k in zip(order, gap, parts)])


def without_effects(scan: Scan, fit: Fit) -> Scan:
    """Line integrals of measured views: without the response that was fitted, and `corrected`, with the cloud, for the effects
    that the fit has modelled. Without either, the scan itself."""
    response, effects, cloud = fit.model.response, fit.model.effects, fit.cloud()
    if response is not None:
        scan = replace(scan, projections=response.undone(scan.projections, fit.nominal_geometry))
    if effects is None or cloud is None or not isinstance(fit.method, CloudMethod):
        return scan if scan.effects is None else replace(scan, effects=None)
    return corrected(scan, effects.of_cloud(), [cloud], fit.method.extent)


def complete_views(scan: Scan, fit: Fit, views: int) -> Scan:
    """A scan of `views` views: the measured ones (`as_corrected` and `without_effects`), and views between them, rendered from
    the fit.

    Raises
    ------
    InputError
        For fewer views than were measured, for more than a scan may have, and for a scan that is not a circle about z.
    """
    at_turns(scan.geometry, np.zeros(1))  # fails early, as does the next line
    require_pixels(scan, 'the completion of a scan')
    if views > MOST_VIEWS:
        raise InputError(f'{views} views were asked for, but a scan has at most {MOST_VIEWS}')
    check_memory(scan.geometry.on(scan.geometry.grid.slab(0, 1)), views=views)  # of the views: no volume is made here
    return insert_views(without_effects(as_corrected(scan, fit), fit), views, fit.line_integrals, scan.geometry)


def insert_views(
    scan: Scan, views: int, render: Callable[[Geometry], np.ndarray], circle: Geometry | None = None
) -> Scan:
    """A scan of `views` views: the given ones, and views between them from `render(geometry)`.

    Parameters
    ----------
    circle : Geometry or None
        Nominal geometry of the views, if a fit has corrected the poses (default: the scan's own).

    Raises
    ------
    InputError
        For fewer views than are given, and for invalid pixels, and for a scan that is not a circle about z.
    """
    require_pixels(scan, 'the completion of a scan')
    geometry = circle or scan.geometry
    if views < len(scan):
        raise InputError(f'{views} views were asked for, but {len(scan)} are measured: ask for more')
    if views == len(scan):
        return scan
    rendered = at_turns(geometry, missing_angles(geometry, views))
    return Scan(scan.geometry.joined(rendered), np.concatenate([scan.projections, render(rendered)]))
