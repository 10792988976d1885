"""A scanner as a figure (Matplotlib), to scale: from above, and from the side of the first view that is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from scipy.spatial import ConvexHull, QhullError

from lingo_mi.geometry.curved import CurvedGeometry
from lingo_mi.geometry.drawing import INK, PANEL, SOURCE, VOLUME

if TYPE_CHECKING:
    from lingo_mi.geometry.base import Geometry

DRAWN = 3  # views, unless others are asked for
FAINT = 0.35  # opacity of all views but the first


class ScannerFigure(Figure):
    """A figure that shows itself in a notebook, whichever backend is active."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format='png', dpi=100)
        return file.getvalue()


def figure(geometry: Geometry, views: np.ndarray) -> Figure:
    """Panels and outermost rays of `views`, int [m], the sources of all views, and the volume, in mm."""
    out = ScannerFigure(figsize=(11, 5.6), layout='constrained')
    first, above, side = views[0], *out.subplots(1, 2)
    _draw(above, geometry, views, np.eye(3)[:2])
    for view in views[1:]:
        _draw_view(above, geometry, view, np.eye(3)[:2], FAINT)
    _draw_view(above, geometry, first, np.eye(3)[:2], 1.0)
    above.set(title='from above', xlabel='x, mm', ylabel='y, mm')
    plane = np.array([_across(geometry, first), [0, 0, 1]])
    _draw(side, geometry, views[:1], plane)
    for view in views[1:]:  # their rays would hide the first view's
        outline = _panel(geometry, view) @ plane.T
        side.plot(*np.vstack([outline, outline[:1]]).T, color=PANEL, linewidth=1, alpha=FAINT, zorder=1)
    _draw_view(side, geometry, first, plane, 1.0)
    side.set(title=f'from the side, view {first}', xlabel=f'across the panel of view {first}, mm', ylabel='z, mm')
    side.axvline(0, color=INK, linestyle=(0, (6, 3, 1, 3)), linewidth=0.8, zorder=1)
    above.plot(0, 0, '+', color=INK, markersize=9, zorder=5)
    (rows, columns), (step_v, step_u) = geometry.nDetector, geometry.dDetector
    place = f', DSO {geometry.DSO:.5g} mm, DSD {geometry.DSD:.5g} mm' if geometry.mode == 'cone' else ''
    bend = f', bent by a radius of {geometry.radius:.5g} mm\n' if isinstance(geometry, CurvedGeometry) else '; '
    count = f'{len(geometry)} view{"s" * (len(geometry) > 1)}'
    sides = ' x '.join(f'{size:.4g}' for size in geometry.grid.size)
    out.suptitle(
        f'{geometry.mode} beam, {count}{place}; panel {columns} x {rows} pixels, {columns * step_u:.4g} x '
        f'{rows * step_v:.4g} mm{bend}volume {sides} mm',
        fontsize='medium',
    )
    out.legend(handles=_handles(geometry), loc='outside lower center', ncols=5, frameon=False)
    return out


def _sources(geometry: Geometry) -> np.ndarray:
    """Return the points from which the beams of all views are drawn, [n, 3]. A parallel beam is drawn from before the volume."""
    rays = geometry.rays(curved=True)
    if geometry.mode == 'cone':
        return rays.source
    return np.asarray(geometry.grid.centre) - 0.8 * np.linalg.norm(geometry.grid.size) * rays.source


def _across(geometry: Geometry, view: int) -> np.ndarray:
    """The horizontal direction across a view's panel, away from its source; x if the panel lies flat."""
    rays = geometry.rays(curved=True)
    normal = np.cross(rays.u[view], rays.v[view])
    normal *= np.sign(normal @ (_panel(geometry, view).mean(0) - _sources(geometry)[view]))
    level = normal * [1, 1, 0]
    return level / np.linalg.norm(level) if np.linalg.norm(level) > 0.02 * np.linalg.norm(normal) else np.eye(3)[0]


def _panel(geometry: Geometry, view: int) -> np.ndarray:
    """The edge of a view's panel, [m, 3]: see `Rays.outline`."""
    return geometry.rays(curved=True).outline(view, geometry.nDetector)


def _draw(axes: Any, geometry: Geometry, labelled: np.ndarray, plane: np.ndarray) -> None:
    """The volume and all sources on a plane, whose two directions are [2, 3], with the numbers of some views."""
    sources, low, high = _sources(geometry) @ plane.T, geometry.grid.low, geometry.grid.high
    box = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)]) @ plane.T
    axes.add_patch(_hull(box, facecolor=VOLUME, edgecolor=VOLUME, alpha=0.35, zorder=2))
    axes.plot(*sources.T, '.', color=SOURCE, markersize=3, alpha=0.6, zorder=3)
    for view in labelled:
        away = sources[view] - box.mean(0)
        offset = 11 * away / max(np.linalg.norm(away), 1e-9)
        axes.annotate(
            str(view), sources[view], offset, textcoords='offset points', ha='center', va='center', fontsize='small'
        )
    axes.set_aspect('equal', adjustable='datalim')
    axes.margins(0.08)
    axes.grid(alpha=0.2, linewidth=0.5)
    axes.spines[['top', 'right']].set_visible(False)


def _draw_view(axes: Any, geometry: Geometry, view: int, plane: np.ndarray, opacity: float) -> None:
    """A view's source, its panel, and the rays to the panel's corners and centre, on a plane."""
    source, panel, (rows, columns) = _sources(geometry)[view], _panel(geometry, view), geometry.nDetector
    x, y = np.array([[0, 1, 1, 0, 0.5], [0, 0, 1, 1, 0.5]]) * [[columns], [rows]]
    ends = geometry.rays(curved=True).points(view, x, y)
    starts = np.broadcast_to(source, ends.shape)
    if geometry.mode == 'parallel':
        beam = geometry.rays(curved=True).source[view]
        starts = ends - ((ends - source) @ beam)[:, None] * beam
    starts, ends, outline = starts @ plane.T, ends @ plane.T, panel @ plane.T
    fan = np.concatenate([starts, ends, outline])
    axes.add_patch(_hull(fan, facecolor=SOURCE, alpha=0.08 * opacity, linewidth=0, zorder=0))
    for i, (start, end) in enumerate(zip(starts, ends)):
        axes.plot(*zip(start, end), '--' if i == 4 else '-', color=INK, linewidth=0.8, alpha=opacity, zorder=1)
    axes.add_patch(Polygon(outline, closed=True, facecolor=PANEL, alpha=0.2 * opacity, linewidth=0, zorder=3))
    axes.plot(*np.vstack([outline, outline[:1]]).T, color=PANEL, linewidth=2.5, alpha=opacity, zorder=4)
    axes.plot(*(source @ plane.T), 'o', color=SOURCE, markersize=6, alpha=opacity, zorder=5)


def _hull(points: np.ndarray, **style: Any) -> Polygon:
    """The convex hull of points [n, 2]."""
    try:
        points = points[ConvexHull(points).vertices]
    except QhullError:  # all on a line
        points = points[[points.sum(1).argmin(), points.sum(1).argmax()]]
    return Polygon(points, closed=True, **style)


def _handles(geometry: Geometry) -> list[Any]:
    start = 'source' if geometry.mode == 'cone' else 'where the beam comes from'
    return [
        Line2D([], [], color=SOURCE, marker='o', linestyle='', label=start),
        Line2D([], [], color=PANEL, linewidth=2.5, label='panel'),
        Line2D([], [], color=INK, linestyle='--', linewidth=0.8, label="ray to the panel's centre"),
        Patch(facecolor=VOLUME, alpha=0.35, label='volume'),
        Line2D([], [], color=INK, marker='+', linestyle=(0, (6, 3, 1, 3)), linewidth=0.8, label='axis of rotation'),
    ]
