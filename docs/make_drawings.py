"""Draw what the pages on concepts explain, without data: `python docs/make_drawings.py`, two seconds.

Writes docs/figures/geometry.svg (frame, distances and axes of a scan), docs/figures/closed_form.svg (a ray through a
Gaussian, and its projection) and docs/figures/curved.png (a clinical scanner).
"""

from pathlib import Path

import matplotlib

matplotlib.use('agg')
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, Polygon, Rectangle

import lingo_mi as lm

FIGURES = Path(__file__).resolve().parent / 'figures'
BLUE, RED, GREY, GREEN = '#2563a8', '#c0392b', '#777777', '#2e7d4f'


def arrow(axes, start, end, colour='black', style='-|>', width=1.4):
    axes.annotate('', end, start, arrowprops=dict(arrowstyle=style, color=colour, lw=width, shrinkA=0, shrinkB=0))


def geometry():
    """The scanner from above and from the side."""
    figure, (above, side) = plt.subplots(1, 2, figsize=(11, 5.2), gridspec_kw=dict(width_ratios=[1.15, 1]))
    a = np.deg2rad(32)
    towards, u = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
    DSO, DSD, half = 3.0, 4.6, 1.3
    source, panel = DSO * towards, (DSO - DSD) * towards

    above.add_patch(Circle((0, 0), DSO, fill=False, ls=':', color=GREY))
    above.add_patch(Rectangle((-0.8, -0.8), 1.6, 1.6, fc='#dfe8f3', ec=BLUE, lw=1.2))
    ends = panel - half * u, panel + half * u
    above.add_patch(Polygon([source, *ends], closed=True, fc='#f6e7c8', ec='none', alpha=0.6, zorder=0))
    above.plot(*np.transpose(ends), color='black', lw=4, solid_capstyle='butt')
    above.plot(*source, 'o', color=RED, ms=9)
    above.text(*(source + [0.12, 0.18]), 'source', color=RED, fontsize=11)
    above.text(*(ends[0] + [-0.1, -0.32]), 'panel', fontsize=11, ha='center')
    arrow(above, (0, 0), (2.1, 0), GREY)
    arrow(above, (0, 0), (0, 2.1), GREY)
    above.text(2.15, -0.08, 'x', color=GREY, fontsize=12)
    above.text(-0.08, 2.2, 'y', color=GREY, fontsize=12)
    turn = np.linspace(0, a, 30)
    above.plot(1.35 * np.cos(turn), 1.35 * np.sin(turn), color=GREEN)
    above.text(1.45, 0.33, 'angle $a$', color=GREEN, fontsize=11)
    beside = panel - 0.25 * towards
    arrow(above, beside - 0.5 * u, beside + 0.5 * u, BLUE)
    above.text(*(beside + [-0.35, -0.1]), '$u$', color=BLUE, fontsize=14)
    for start, length, shift, name in ((source, DSO, 1.55, 'DSO'), (source, DSD, 2.15, 'DSD')):
        first, last = start - shift * u, start - length * towards - shift * u
        arrow(above, first, last, 'black', '<|-|>', 1.0)
        above.text(*((first + last) / 2 + [0.12, -0.38]), name, fontsize=11)
        for end in (first, last):
            above.plot(*np.transpose([end + 0.1 * u, end - 0.1 * u]), color='black', lw=1)
    above.text(-0.74, -0.72, 'volume [x, y, z]', color=BLUE, fontsize=9)
    above.set_title('from above: the axis of rotation is z', fontsize=11)
    above.set(xlim=(-3.3, 4.6), ylim=(-3.4, 3.4))

    side.add_patch(Rectangle((-0.8, -0.7), 1.6, 1.4, fc='#dfe8f3', ec=BLUE, lw=1.2))
    side.add_patch(Polygon([(3, 0), (-1.6, 1.3), (-1.6, -1.3)], closed=True, fc='#f6e7c8', alpha=0.6, zorder=0))
    side.plot([-1.6, -1.6], [-1.3, 1.3], color='black', lw=4, solid_capstyle='butt')
    side.plot(3, 0, 'o', color=RED, ms=9)
    side.text(2.75, 0.22, 'source', color=RED, fontsize=11)
    side.plot([0, 0], [-1.75, 1.75], color=GREY, ls='--', lw=1)
    arrow(side, (0, 1.2), (0, 1.95), GREY)
    side.text(0.1, 1.78, 'z', color=GREY, fontsize=12)
    arrow(side, (-1.85, 1.3), (-1.85, 0.35), BLUE)
    side.text(-2.15, 0.72, '$v$', color=BLUE, fontsize=14)
    side.text(-2.6, 1.42, 'row 0', fontsize=10, color=BLUE)
    side.plot([3, -1.6], [0, 0.85], color=RED, lw=1)
    side.text(0.95, 0.56, 'ray of pixel [v, u]', color=RED, fontsize=10)
    side.text(-0.72, -0.6, 'volume, centre\nat offOrigin', color=BLUE, fontsize=8.5)
    side.set_title('from the side: rows run down, $v = (0, 0, -1)$', fontsize=11)
    side.set(xlim=(-2.9, 3.7), ylim=(-2.3, 2.3))
    for axes in (above, side):
        axes.set_aspect('equal')
        axes.axis('off')
    save(figure, 'geometry')


def closed_form():
    """The density along a ray, the integral under it, and the footprint on a panel."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3.6))
    turn = np.deg2rad(25)
    axes_ = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    inverse = axes_ @ np.diag([1 / 0.9**2, 1 / 0.35**2]) @ axes_.T
    x, y = np.meshgrid(np.linspace(-2.6, 2.6, 160), np.linspace(-1.5, 1.7, 100))
    power = inverse[0, 0] * x**2 + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y**2
    left.imshow(np.exp(-power / 2), cmap='Blues', extent=(-2.6, 2.6, -1.5, 1.7), origin='lower')
    left.contour(x, y, power, levels=[1, 4, 9], colors=GREY, linewidths=0.7)
    start, direction = np.array([-2.5, -0.95]), np.array([5.0, 1.75])
    arrow(left, start, start + direction, RED)
    left.plot(*start, 'o', color=RED)
    left.text(-2.45, -1.3, '$o$', color=RED, fontsize=13)
    left.text(1.5, 1.12, '$o + tD$', color=RED, fontsize=12)
    left.plot(0, 0, '+', color='black')
    left.text(0.1, -0.42, '$p$', fontsize=13)
    left.set_title('a ray through a Gaussian', fontsize=11)
    left.set_aspect('equal')
    left.axis('off')

    t = np.linspace(0, 1, 400)
    along = start[:, None] + direction[:, None] * t
    value = np.exp(-np.einsum('it,ij,jt->t', along, inverse, along) / 2)
    middle.plot(t, value, color=BLUE)
    middle.fill_between(t, value, color='#dfe8f3')
    middle.text(0.5, 0.3 * value.max(), 'the integral:\none formula', ha='center', fontsize=10)
    middle.set(xlabel='$t$', ylabel='density', xticks=[], yticks=[], ylim=(0, None))
    middle.set_title('density along it: a Gaussian again', fontsize=11)
    middle.spines[['top', 'right']].set_visible(False)

    distance = 2.0  # from the source, at the origin, to the panel; the Gaussian is half way, and wide
    s = np.linspace(-0.6, 2.4, 400)
    point = np.array([0.0, 0.9])
    D = np.stack([np.full_like(s, distance), s])
    p = np.array([1.0, point[1] * 0.5])
    W = np.diag([1 / 0.45, 1 / 0.2])
    w, d = W @ p, W @ D
    length = np.hypot(*d)
    cross = w[0] * d[1] - w[1] * d[0]
    exact = np.hypot(*D) / length * np.exp(-0.5 * cross**2 / length**2)
    s0 = p[1] / p[0] * distance
    d0 = W @ np.array([distance, s0])
    slope = (w[0] * W[1, 1] * (s - s0)) ** 2 / (d0 @ d0)
    affine = np.hypot(distance, s0) / np.sqrt(d0 @ d0) * np.exp(-0.5 * slope)
    right.plot(s, exact / exact.max(), color=BLUE, label='exact')
    right.plot(s, affine / exact.max(), color=RED, ls='--', label='affine (EWA)')
    right.set(xlabel='position on the panel', xticks=[], yticks=[], ylim=(0, None))
    right.set_title('footprint in a wide cone beam', fontsize=11)
    right.legend(frameon=False, fontsize=9)
    right.spines[['top', 'right']].set_visible(False)
    save(figure, 'closed_form')


def curved():
    """Two views of a helical scanner whose panel is bent about its focal spot."""
    panel = dict(nDetector=(64, 736), dDetector=(1.0947, 1.2858), offDetector=(0, 1.2858 / 4))
    turns = dict(pitch=38.4, angles=lm.circular(1440, total=720, start=-360))
    flat = lm.Geometry.helix(DSO=595, DSD=1085.6, **panel, **turns, nVoxel=(512, 512, 64), dVoxel=(0.8, 0.8, 1))
    flat.curved().show(views=[0, 500]).savefig(FIGURES / 'curved.png', dpi=80)


def save(figure, name: str):
    figure.tight_layout()
    figure.savefig(FIGURES / f'{name}.svg', metadata=dict(Date=None), bbox_inches='tight', pad_inches=0.1)
    plt.close(figure)


if __name__ == '__main__':
    plt.rcParams['svg.hashsalt'] = 'lingo_mi'  # the same file every time
    geometry()
    closed_form()
    curved()
