"""A scanner as a drawing (SVG), to scale: from above, and from the side."""

from __future__ import annotations

import numpy as np

from lingo_mi.geometry.grid import Grid
from lingo_mi.geometry.rays import Rays

SOURCE, PANEL, VOLUME, INK = '#c2570c', '#1a7f5a', '#3b76c4', '#7a8694'  # seen on white and on black
WIDTH, HEIGHT, MARGIN, MOST = 300, 230, 16, 360


def drawing(rays: Rays, nDetector: tuple[int, int], grid: Grid) -> str:
    """Sources, the panel of the first view and its outermost rays, and the volume, seen along z and along y: `<svg ...`.

    Parameters
    ----------
    rays : Rays
        Rays of all views; nDetector: the panel's pixels, (v, u).
    grid : Grid
        The volume.
    """
    chosen = np.unique(np.linspace(0, len(rays) - 1, min(len(rays), MOST)).astype(int))
    sources = rays.source[chosen]
    if rays.parallel:
        sources = np.asarray(grid.centre) - 1.3 * max(grid.size) * sources
    panel = rays.outline(0, nDetector)
    corners = panel[[0, len(panel) // 2 - 1, len(panel) // 2, -1]]
    starts = corners - np.dot(corners - sources[0], rays.source[0])[:, None] * rays.source[0] if rays.parallel else None
    parts = [
        _seen(across, up, sources, panel, corners, starts, grid.low, grid.high, WIDTH * i)
        for i, (across, up) in enumerate(((0, 1), (0, 2)))
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{2 * WIDTH}" height="{HEIGHT}" viewBox="0 0 {2 * WIDTH} {HEIGHT}" '
        f'role="img" aria-label="The scanner from above and from the side" font-family="sans-serif" font-size="11">'
        f'{"".join(parts)}</svg>'
    )


def _seen(across, up, sources, panel, corners, starts, low, high, left) -> str:
    points = np.concatenate([sources, panel, [low, high]])[:, [across, up]]
    least, most = points.min(0), points.max(0)
    room = np.array([WIDTH - 2 * MARGIN, HEIGHT - 2 * MARGIN - 14])
    scale = float(np.min(room / np.maximum(most - least, 1e-9)))
    middle = (least + most) / 2

    def place(point):
        x, y = (np.asarray(point)[[across, up]] - middle) * scale
        return f'{left + WIDTH / 2 + x:.1f},{(HEIGHT + 14) / 2 - y:.1f}'

    def line(colour, width, *ends):
        return f'<polyline points="{" ".join(map(place, ends))}" fill="none" stroke="{colour}" stroke-width="{width}"/>'

    box = np.array([low, low, high, high])
    box[1, across], box[3, across] = high[across], low[across]
    box[2, up], box[3, up] = high[up], high[up]
    box[1, up] = low[up]
    begin = [sources[0]] * 4 if starts is None else starts
    rays = ''.join(line(INK, 0.6, begin[i], corners[i]) for i in range(4))
    dots = ''.join('<circle cx="{}" cy="{}" r="2" fill="{}"/>'.format(*place(s).split(','), SOURCE) for s in sources)
    title = f'{"from above" if up == 1 else "from the side"}: {"xyz"[across]} right, {"xyz"[up]} up'
    return (
        f'<text x="{left + MARGIN}" y="13" fill="{INK}">{title}</text>{rays}{line(PANEL, 3, *panel, panel[0])}'
        f'<polygon points="{" ".join(map(place, box))}" fill="{VOLUME}" fill-opacity=".35" stroke="{VOLUME}"/>{dots}'
    )
