"""Figures of a reconstruction, drawn with matplotlib's objects (no pyplot, no display, no global state).

A section is a function draw(figure, data) with a height for a given width. `sections` lists those for which a
`lingo_mi.report.data.ReportData` has content, and `overview` puts them on one sheet.

Orientation of slices: x to the right and y up (axial), x to the right and z up (coronal), y to the right and z up
(sagittal). Orientation of views: u to the right, v down.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lingo_mi.common.notebook import grey_range
from lingo_mi.report.planes import plane, plane_extent, planes, richest, series

PLANES = {2: ('Axial', 'x', 'y', 'z'), 1: ('Coronal', 'x', 'z', 'y'), 0: ('Sagittal', 'y', 'z', 'x')}
DIFFERENCE = 'RdBu_r'
COLOURS = {'loss': '#444444', 'psnr_2d': '#1f77b4', 'psnr_3d': '#d6641e', 'gaussians': '#2a7f4f'}
PADS = {'w_pad': 0.1, 'h_pad': 0.06}  # inches around everything
MOST_POINTS = 30_000  # of a scatter plot; more cannot be distinguished
STYLE: dict = {
    'font.size': 10,
    'axes.titlesize': 10.5,
    'axes.labelsize': 10,
    'xtick.labelsize': 9,
    'ytick.labelsize': 9,
    'legend.fontsize': 9,
    'font.family': 'DejaVu Sans',
    'axes.formatter.limits': (-3, 5),
}


# ---- Sections ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Section:
    """One block of the picture: its name, how to draw it, and its height for a width (inches)."""

    name: str
    draw: Callable
    height: Callable[[float], float]
    wide: bool = False  # takes a whole row


def sections(data: Any) -> list[Section]:
    """The sections for which `data` has content, top to bottom."""
    out = []
    single = len(planes(data.shape)) == 1
    if data.volume is not None:
        out.append(Section('Slices', draw_slices, lambda width: _slices_height(data, width), single))
    if data.views is not None:
        out.append(Section('Held-out views', draw_views, lambda width: _views_height(data, width), single))
    if data.cloud_centres is not None and len(data.cloud_centres):
        out.append(Section('Gaussians', draw_cloud, lambda width: _cloud_height(data, width)))
    if any(len(series(data.history, 'iteration', y)[0]) for y in ('loss', 'psnr_2d', 'psnr_3d', 'gaussians')):
        out.append(Section('Convergence', draw_curves, lambda width: 5.2))
    return out


def draw_slices(fig: Any, data: Any) -> None:
    """Orthogonal slices, in rows: reconstruction, truth, difference. A single-slice volume takes one row."""
    shape, axes = data.shape, planes(data.shape)
    reference = data.volume if data.truth is None else data.truth
    index = {axis: richest(reference, axis) for axis in axes}
    kinds = {'Reconstruction': data.volume}
    if data.truth is not None:
        kinds |= {'Truth': data.truth, 'Difference': data.volume - data.truth}
    shown = {kind: [plane(v, axis, index[axis]) for axis in axes] for kind, v in kinds.items()}
    low, high = grey_range(
        *(np.concatenate([p.ravel() for p in images]) for kind, images in shown.items() if kind != 'Difference')
    )

    single = len(axes) == 1
    extents = [plane_extent(shape, data.spacing, data.centre, axis) for axis in axes]
    widths = [e[1] - e[0] for e in extents]
    grid = (
        fig.subplots(1, len(kinds), squeeze=False).T
        if single
        else fig.subplots(len(kinds), len(axes), squeeze=False, width_ratios=widths)
    )
    for row, (kind, images) in enumerate(shown.items()):
        scale = _difference_range(images) if kind == 'Difference' else (low, high)
        for column, (axis, image, extent) in enumerate(zip(axes, images, extents)):
            ax = grid[row, column]
            drawn = ax.imshow(
                image,
                origin='lower',
                extent=extent,
                vmin=scale[0],
                vmax=scale[1],
                cmap=DIFFERENCE if kind == 'Difference' else 'gray',
                interpolation='nearest',
            )
            name, across, up, through = PLANES[axis]
            place = data.centre[axis] + (index[axis] + 0.5 - shape[axis] / 2) * data.spacing[axis]
            title = f'{name}, {through} = {place:.4g} mm'
            first = column == 0
            if single:
                ax.set_title(f'{kind}\n{title}' if row == 0 else kind)
            elif row == 0:
                ax.set_title(title)
            ax.set_ylabel(f'{kind}\n{up} [mm]' if first and not single else f'{up} [mm]')
            _ticks(ax)
            if single or row == len(kinds) - 1:
                ax.set_xlabel(f'{across} [mm]')
            else:
                ax.tick_params(labelbottom=False)
        _bar(fig, drawn, list(grid[row]), ('Δ ' if kind == 'Difference' else '') + data.quantity)


def draw_views(fig: Any, data: Any) -> None:
    """Held-out views, in columns: rendered, measured or the reference, residual. Line plots for a detector of one row."""
    chosen = _spread(len(data.views), 3)
    titles = [f'View at {data.views_angles[i]:.4g}°{_residual(data, i)}' for i in chosen]
    (nv, nu), (dv, du) = data.views.shape[1:], data.pixel
    if nv == 1:
        _draw_lines(fig, data, chosen, titles)
        return
    kinds = {'Rendered': data.views[chosen]}
    if data.views_truth is not None:
        reference = data.views_truth[chosen]
        kinds |= {data.reference: reference, 'Residual': data.views[chosen] - reference}
    low, high = grey_range(*(v for k, v in kinds.items() if k != 'Residual'))
    extent = (-nu * du / 2, nu * du / 2, nv * dv / 2, -nv * dv / 2)
    grid = fig.subplots(len(kinds), len(chosen), squeeze=False)
    for row, (kind, images) in enumerate(kinds.items()):
        scale = _difference_range(images) if kind == 'Residual' else (low, high)
        for column, image in enumerate(images):
            ax = grid[row, column]
            drawn = ax.imshow(
                image,
                origin='upper',
                extent=extent,
                vmin=scale[0],
                vmax=scale[1],
                cmap=DIFFERENCE if kind == 'Residual' else 'gray',
                interpolation='nearest',
            )
            if row == 0:
                ax.set_title(titles[column])
            _ticks(ax)
            if column == 0:
                ax.set_ylabel(f'{kind}\nv [mm]')
            else:
                ax.tick_params(labelleft=False)
            if row == len(kinds) - 1:
                ax.set_xlabel('u [mm]')
            else:
                ax.tick_params(labelbottom=False)
        _bar(fig, drawn, list(grid[row]), 'Δ ln(I0/I)' if kind == 'Residual' else 'ln(I0/I)')


def _residual(data, view):
    """The residual of a view, for its title."""
    rms = (data.metrics.get('residual_by_view') or {view: None})[view]
    return '' if rms is None else f'\nresidual {rms:.3g} rms'


def _draw_lines(fig, data, chosen, titles):
    nu, du = data.views.shape[2], data.pixel[1]
    u = (np.arange(nu) + 0.5 - nu / 2) * du
    compared = data.views_truth is not None
    grid = fig.subplots(
        2 if compared else 1,
        len(chosen),
        squeeze=False,
        sharex=True,
        sharey='row',
        height_ratios=[2, 1] if compared else [1],
    )
    for column, (i, title) in enumerate(zip(chosen, titles)):
        ax = grid[0, column]
        ax.plot(u, data.views[i, 0], color='#1f77b4', lw=1.4, label='rendered')
        ax.set_title(title)
        if compared:
            ax.plot(u, data.views_truth[i, 0], color='black', lw=1, ls='--', label=data.reference.lower())
            grid[1, column].axhline(0, color='#999999', lw=0.8)
            grid[1, column].plot(u, data.views[i, 0] - data.views_truth[i, 0], color='#b2182b', lw=1)
        grid[-1, column].set_xlabel('u [mm]')
    for ax in grid.flat:
        ax.grid(alpha=0.25)
    grid[0, 0].set_ylabel('ln(I0/I)')
    if compared:
        grid[1, 0].set_ylabel('residual')
        grid[0, 0].legend(loc='best', frameon=False)


def draw_cloud(fig: Any, data: Any) -> None:
    """The Gaussians' centres, seen along z and along y (only along z for a single-slice volume)."""
    centres, density = data.cloud_centres, data.cloud_density
    if len(centres) > MOST_POINTS:
        keep = np.random.default_rng(0).choice(len(centres), MOST_POINTS, replace=False)
        centres, density = centres[keep], density[keep]
    order = np.argsort(density)
    centres, density = centres[order], density[order]
    axes = _cloud_planes(data)
    grid = fig.subplots(1, len(axes), squeeze=False)[0]
    # Otherwise a few very dense Gaussians would give all others one colour.
    top = float(np.percentile(density, 99)) or None
    for ax, axis in zip(grid, axes):
        extent = plane_extent(data.shape, data.spacing, data.centre, axis)
        name, across, up, _ = PLANES[axis]
        a, b = (i for i in range(3) if i != axis)
        drawn = ax.scatter(
            centres[:, a],
            centres[:, b],
            c=density,
            s=np.clip(8e4 / len(centres), 3, 25),
            cmap='plasma',
            vmin=0,
            vmax=top,
            linewidths=0,
            rasterized=True,
        )
        margin = 0.03 * max(extent[1] - extent[0], extent[3] - extent[2])
        ax.set(
            xlim=(extent[0] - margin, extent[1] + margin),
            ylim=(extent[2] - margin, extent[3] + margin),
            aspect='equal',
            facecolor='black',
            xlabel=f'{across} [mm]',
            ylabel=f'{up} [mm]',
            title=f'Seen along {PLANES[axis][3]}',
        )
        ax.plot([extent[i] for i in (0, 1, 1, 0, 0)], [extent[i] for i in (2, 2, 3, 3, 2)], color='#777777', lw=0.8)
        _ticks(ax)
    _bar(fig, drawn, list(grid), data.cloud_unit)


def draw_curves(fig: Any, data: Any) -> None:
    """Loss, PSNR and number of Gaussians against iterations and against seconds, if known."""
    rows = [('Loss', ['loss']), ('PSNR [dB]', ['psnr_2d', 'psnr_3d']), ('Gaussians', ['gaussians'])]
    names = {'psnr_2d': '2D, held-out views', 'psnr_3d': '3D, volume'}
    columns = [('iteration', 'iteration'), ('seconds', 'time [s]')]

    def has_points(x, key):
        return len(series(data.history, x, key)[0]) > 0

    rows = [(label, [key for key in keys if has_points('iteration', key)]) for label, keys in rows]
    rows = [(label, keys) for label, keys in rows if keys]
    columns = [c for c in columns if any(has_points(c[0], key) for _, keys in rows for key in keys)]
    grid = fig.subplots(len(rows), len(columns), squeeze=False, sharex='col', sharey='row')
    for i, (label, keys) in enumerate(rows):
        for j, (x, _) in enumerate(columns):
            ax = grid[i, j]
            for key in keys:
                points = series(data.history, x, key)
                ax.plot(
                    *points,
                    color=COLOURS[key],
                    lw=1.4,
                    label=names.get(key),
                    zorder=3,
                    marker='o' if len(points[0]) <= 12 else None,
                    ms=3.5,
                )
            ax.grid(alpha=0.25)
            ax.margins(x=0.02)
        values = np.concatenate([series(data.history, 'iteration', k)[1] for k in keys])
        if label == 'Loss' and values.min() > 0 and values.max() > 10 * values.min():
            grid[i, 0].set_yscale('log')
        if label == 'Gaussians':
            grid[i, 0].yaxis.set_major_formatter('{x:,.0f}')
        grid[i, 0].set_ylabel(label)
        if label.startswith('PSNR'):
            low, high = grid[i, 0].get_ylim()
            grid[i, 0].set_ylim(low - 0.25 * (high - low), high)  # room for the legend below the curves
            grid[i, 0].legend(loc='lower right', ncols=2, frameon=False)
    for ax, (_, label) in zip(grid[-1], columns):
        ax.set_xlabel(label)
    fig.align_ylabels(grid[:, 0])


# ---- Sheets --------------------------------------------------------------------------------------


def overview(data: Any, headline: str, width: float = 19.0, dpi: int = 100) -> bytes:
    """All sections as one PNG, two beside each other, under the title and the line `headline`."""
    rows: list[list[Section]] = []
    for section in sections(data):
        if not section.wide and rows and len(rows[-1]) == 1 and not rows[-1][0].wide:
            rows[-1].append(section)
        else:
            rows.append([section])
    shares = [_shares(row, width) for row in rows]
    heights = [[s.height(width * share) + 0.4 for s, share in zip(*pair)] for pair in zip(rows, shares)]
    tallest = [max(h) for h in heights]

    def draw(fig):
        parts = fig.subfigures(len(rows) + 1, 1, height_ratios=[1, *tallest], hspace=0)
        shown = dict(ha='center', va='center', parse_math=False)  # a name may have dollars
        parts[0].text(0.5, 0.66, data.title, fontsize=20, weight='bold', **shown)
        parts[0].text(0.5, 0.2, headline, fontsize=13, color='#333333', **shown)
        for part, row, share, heights_of_row, height in zip(parts[1:], rows, shares, heights, tallest):
            for sub, section, h in zip(
                np.ravel(part.subfigures(1, len(row), wspace=0.03, width_ratios=share)), row, heights_of_row
            ):
                if h < 0.9 * height:  # align a lower section with the top of its neighbour
                    sub = sub.subfigures(2, 1, height_ratios=[h, height - h])[0]
                sub.suptitle(section.name, fontsize=13, weight='bold')
                section.draw(sub, data)

    return _png(draw, width, sum(tallest) + 1, dpi)


def _shares(row: list[Section], width: float) -> list[float]:
    """The parts of the width that sections beside each other take, so that they are of one height, as far as that can be."""
    if len(row) == 1:
        return [1.0]
    low, high = 0.36, 0.64
    for _ in range(12):
        middle = (low + high) / 2
        if row[0].height(width * middle) < row[1].height(width * (1 - middle)):
            low = middle
        else:
            high = middle
    return [low, 1 - low]


def _png(draw, width, height, dpi):
    import matplotlib
    from matplotlib.figure import Figure

    out = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        fig = Figure(figsize=(width, height), layout='constrained')
        engine: Any = fig.get_layout_engine()  # the one that was just chosen
        engine.set(**PADS)
        draw(fig)
        fig.savefig(out, format='png', dpi=dpi)
    return out.getvalue()


# ---- Helpers -------------------------------------------------------------------------------------


def _difference_range(images):
    sizes = [np.abs(image) for image in images]
    largest = max(np.percentile(x, 99.8) for x in sizes) or max(x.max() for x in sizes) or 1e-6
    return -largest, largest


def _bar(fig, drawn, axes, label):
    fig.colorbar(drawn, ax=axes, label=label, shrink=0.9, aspect=22, pad=0.015)


def _ticks(ax):
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.yaxis.set_major_locator(MaxNLocator(4))


def _spread(total, n):
    n = min(total, n)
    return [i * total // n for i in range(n)]


def _slices_height(data, width):
    shape = data.shape
    extents = [plane_extent(shape, data.spacing, data.centre, axis) for axis in planes(shape)]
    wide, high = sum(e[1] - e[0] for e in extents), max(e[3] - e[2] for e in extents)
    kinds = 1 if data.truth is None else 3
    if len(extents) == 1:
        return float(np.clip((width - 3) / kinds * high / wide, 2, 7)) + 0.9
    return kinds * float(np.clip((width - 3.2) * high / wide, 1.2, 4)) + 0.9


def _views_height(data, width):
    kinds = 1 if data.views_truth is None else 3
    nv, nu = data.views.shape[1:]
    if nv == 1:
        return 4.4 if kinds == 3 else 3.2
    columns = min(len(data.views), 3)
    ratio = nv * data.pixel[0] / (nu * data.pixel[1])
    return kinds * float(np.clip((width - 2.2) / columns * ratio, 0.8, 4)) + 0.9


def _cloud_planes(data):
    return planes(data.shape)[:2]


def _cloud_height(data, width):
    axes = _cloud_planes(data)
    extents = [plane_extent(data.shape, data.spacing, data.centre, axis) for axis in axes]
    ratio = max((e[3] - e[2]) / (e[1] - e[0]) for e in extents)
    return float(np.clip((width - 2.6) / len(axes) * ratio, 2.5, 6)) + 0.9
