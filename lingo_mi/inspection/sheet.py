"""One picture of a scan: its geometry, three views, and the mass of every view. No pyplot, no global state."""

from __future__ import annotations

from os import PathLike

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lingo_mi.inspection.measure import Findings
from lingo_mi.scan import Scan
from lingo_mi.storage.file_access import replacing


def draw(path: PathLike | str, scan: Scan, findings: Findings) -> None:
    """Writes a PNG.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    figure = Figure(figsize=(13, 6.4), layout='constrained')
    FigureCanvasAgg(figure)
    _geometry(figure.add_subplot(2, 4, (1, 6), projection='3d'), scan)
    low = min(0.0, float(np.percentile(scan.projections, 0.2)))
    high = max(float(np.percentile(scan.projections, 99.8)), low + 1e-9)
    (nv, nu), (dv, du) = scan.geometry.nDetector, scan.geometry.dDetector
    aspect = 'auto' if nv < nu / 8 else dv / du  # a row of a fan beam would be a line
    for place, i in zip((3, 4, 7), np.linspace(0, len(scan) - 1, 3).astype(int)):
        axes = figure.add_subplot(2, 4, place)
        axes.imshow(scan.projections[i], cmap='gray', vmin=low, vmax=high, aspect=aspect)
        axes.set_title(f'view {i}', fontsize=10)
        axes.set(xticks=[], yticks=[])
    axes = figure.add_subplot(2, 4, 8)
    axes.plot(findings.mass, '.-', color='#1f77b4', markersize=4, linewidth=0.8)
    axes.plot(findings.suspects, findings.mass[findings.suspects], 'o', color='#d1495b', fillstyle='none')
    axes.set_title('mean line integral of a view', fontsize=10)
    axes.set(xlabel='view', ylim=(1.2 * min(findings.mass.min(), 0), 1.2 * max(findings.mass.max(), 1e-9)))
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=100, format='png')


def _geometry(axes, scan):
    """Sources (or directions), panels of the first and the middle view, and the volume; mm."""
    geometry, rays = scan.geometry, scan.geometry.rays(curved=True)
    size = np.array(geometry.grid.size) / 2
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size + geometry.grid.centre
    for a in range(8):
        for bit in (1, 2, 4):
            if not a & bit:
                axes.plot(*corners[[a, a | bit]].T, color='#444444', linewidth=1)
    source = -rays.source * size.max() * 3 if rays.parallel else rays.source
    axes.plot(*source.T, '.', color='#d1495b', markersize=3)
    axes.plot(*source[:1].T, 'o', color='#d1495b')
    for k, colour in ((0, '#1f77b4'), (len(scan) // 3, '#9ec5e5')):
        panel = rays.outline(k, geometry.nDetector)
        axes.plot(*np.vstack([panel, panel[:1]]).T, color=colour)
    axes.set(xlabel='x', ylabel='y', zlabel='z')
    axes.set_aspect('equal')
    axes.set_title('sources (first: large), panels of two views, volume; mm', fontsize=10)
