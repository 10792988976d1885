"""Tables and plots of what `accuracy.measure` found, and their way into the documentation."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.projectors.cutoff import PRESETS
from lingo_mi.report.figures import STYLE

GRADIENTS = 'centre', 'scale', 'rotation', 'density'
BACKWARD = 'gradients'
RED, BLUE, GREEN, ORANGE, GREY, PURPLE = 'tab:red', 'tab:blue', 'tab:green', 'tab:orange', 'tab:gray', 'tab:purple'


def write(found: dict, folder: Path, figures: Path, document: Path | None = None):
    """Write accuracy.json and accuracy.md into `folder`, the plots into `figures`, and the tables into `document`."""
    tables = make_tables(found)
    for path in (folder, figures):
        path.mkdir(parents=True, exist_ok=True)
    (folder / 'accuracy.json').write_text(json.dumps(found, indent=1) + '\n', encoding='utf-8')
    text = '\n\n'.join(f'## {TITLES[name]}\n\n{table}' for name, table in tables.items())
    (folder / 'accuracy.md').write_text(f'# Accuracy against time\n\n{text}\n', encoding='utf-8')
    draw(found, figures)
    if document:
        document.write_text(insert(document.read_text(encoding='utf-8'), tables, document), encoding='utf-8')


def insert(text: str, tables: dict, where='the document') -> str:
    """The text with what stands between `<!-- table NAME -->` and `<!-- end NAME -->` replaced by the table."""
    for name, table in tables.items():
        pattern = re.compile(f'(<!-- table {name} -->\n).*?(<!-- end {name} -->)', re.DOTALL)
        if not pattern.search(text):
            raise InputError(
                f'{where}: there is no place for the table {name}: <!-- table {name} --> <!-- end {name} -->'
            )
        text = pattern.sub(lambda m: f'{m[1]}{table}\n{m[2]}', text)
    return text


# ------------------------------------------------------------------------------------------------------------
#  Tables
# ------------------------------------------------------------------------------------------------------------

TITLES = dict(
    conditions='Conditions',
    presets='Presets',
    cutoff='Cut-off',
    footprint='Footprint',
    methods='Methods',
    marching='Marching',
    pixel='Pixel',
    teams='Shares of the work',
    scaling='Scaling',
    initialisations='Initial clouds',
    fits='Fits',
)


def make_tables(found: dict) -> dict[str, str]:
    """Markdown tables by name, those of TITLES."""
    first = dict(
        cutoff='cut-off, σ',
        footprint='footprint',
        methods='method',
        marching='method',
        pixel='rays a pixel',
        teams='shares, of the usual number',
    )
    tables = {name: table(_COMPARE, found[name], title) for name, title in first.items()}
    wrong = ('wrong rays', lambda r: f'{100 * r["wrong_rays"]:.2g} %')
    tables['marching'] = table([_COMPARE[0], wrong, *_COMPARE[1:]], found['marching'], first['marching'])
    tables['conditions'] = conditions(found['conditions'])
    tables['presets'] = table(_PRESETS, presets(found['cutoff']))
    tables['scaling'] = table(
        _SCALING, [dict(row, sweep=sweep) for sweep, rows in found['scaling'].items() for row in rows]
    )
    tables['initialisations'] = table(_INITIAL, found['initialisations'])
    tables['fits'] = table(_FITS, found['fits'])
    return {name: tables[name] for name in TITLES}


def table(columns, rows, first: str | None = None) -> str:
    """A Markdown table. columns   (title, row -> text) each; first   another title for the first one"""
    titles = [first or columns[0][0], *(title for title, _ in columns[1:])]
    lines = ['| ' + ' | '.join(titles) + ' |', '|---|' + '---:|' * (len(titles) - 1)]
    return '\n'.join(lines + ['| ' + ' | '.join(cell(row) for _, cell in columns) + ' |' for row in rows])


def conditions(c: dict) -> str:
    """What was measured on what, in a sentence."""
    s = c['sizes']
    return (
        f'`{c["variant"]}` on {c["threads"]} threads of {c["machine"]}. Unless a table says otherwise: '
        f'{s["gaussians"]:,} Gaussians ({s["few"]:,} where other methods are compared, {s["few"] // 2:,} for pixels), '
        f'{s["pixels"]} × {s["pixels"]} pixels, {s["box"]:g} pixels in the box of a Gaussian at 3 σ; '
        f'medians of up to {s["rounds"]} rounds ± half the interquartile range.'
    )


def presets(cutoff: list[dict]) -> list[dict]:
    """The rows of the presets' cut-offs, times relative to the default's."""
    rows = {float(row['name']): row for row in cutoff}
    usual = rows[PRESETS['default']]
    return [
        dict(
            rows[extent],
            preset=name,
            extent=extent,
            relative=rows[extent]['forward_ms'] / usual['forward_ms'],
            relative_gradients=rows[extent][f'{BACKWARD}_ms'] / usual[f'{BACKWARD}_ms'],
        )
        for name, extent in PRESETS.items()
    ]


def _error(key):
    return lambda row: f'{row[key]:.1e}' if key in row else '–'


def _worst_max(row):
    """The largest deviation in any of the four derivatives, over the largest value of that derivative."""
    return f'{max(row[f"{key}_max"] for key in GRADIENTS):.1e}' if f'{GRADIENTS[0]}_max' in row else '–'


def _time(key):
    def cell(row):
        if f'{key}_ms' not in row:
            return '–'
        low, high = row[f'{key}_quartiles_ms']
        digits = max(0, min(2, 1 - int(np.floor(np.log10(row[f'{key}_ms'])) - 1)))
        if row[f'{key}_repeats'] == 1:
            return f'{row[f"{key}_ms"]:.{digits}f}, once'
        return f'{row[f"{key}_ms"]:.{digits}f} ± {(high - low) / 2:.{digits}f}'

    return cell


def _number(key, form):
    return lambda row: form.format(row[key]) if row.get(key) is not None else '–'


_COMPARE = [
    ('', _number('name', '{}')),
    ('image, L2', _error('image')),
    ('image, max', _error('image_max')),
    *((f'∂ {key}', _error(key)) for key in GRADIENTS),
    ('∂, max', _worst_max),
    ('forward, ms', _time('forward')),
    ('with gradients, ms', _time(BACKWARD)),
    ('memory, MB', _number('memory_mb', '{:.1f}')),
    ('with gradients, MB', _number('memory_gradients_mb', '{:.1f}')),
]
_PRESETS = [
    ('`accuracy`', _number('preset', '`{}`')),
    ('cut-off, σ', _number('extent', '{:g}')),
    ('image, L2', _error('image')),
    *((f'∂ {key}', _error(key)) for key in GRADIENTS),
    ('time, forward', _number('relative', '{:.2f}')),
    ('time, with gradients', _number('relative_gradients', '{:.2f}')),
]
_SCALING = [
    ('sweep', _number('sweep', '{}')),
    ('Gaussians', _number('gaussians', '{:,}')),
    ('panel', _number('side', '{0}²')),
    ('pairs', _number('pairs', '{:.1e}')),
    ('forward, ms', _time('forward')),
    ('ns a pair', _number('forward_ns_per_pair', '{:.2f}')),
    ('of kernels', _number('forward_kernels_ns_per_pair', '{:.2f}')),
    ('with gradients, ms', _time(BACKWARD)),
    ('ns a pair', _number(f'{BACKWARD}_ns_per_pair', '{:.2f}')),
    ('of kernels', _number(f'{BACKWARD}_kernels_ns_per_pair', '{:.2f}')),
    ('memory, MB', _number('memory_mb', '{:.1f}')),
    ('with gradients, MB', _number('memory_gradients_mb', '{:.1f}')),
]
_QUALITY = [('views, dB', _number('psnr_2d', '{:.2f}')), ('volume, dB', _number('psnr_3d', '{:.2f}'))]
_INITIAL = [
    ('initial cloud', _number('name', '{}')),
    ('Gaussians', _number('points', '{:,}')),
    ('seconds', _number('seconds', '{:.2f}')),
    ('IPSD', _number('ipsd', '{:.3f}')),
    *_QUALITY,
]
_FITS = [
    ('recipe', _number('name', '{}')),
    ('phantom', _number('side', '{0}³')),
    ('panel', _number('pixels', '{0}²')),
    ('iterations', _number('iterations', '{:,}')),
    ('Gaussians, first', _number('points', '{:,}')),
    ('last', _number('gaussians', '{:,}')),
    ('cut-off, σ', _number('extent', '{:g}')),
    ('seconds', _number('seconds', '{:.1f}')),
    *_QUALITY,
]


# ------------------------------------------------------------------------------------------------------------
#  Plots
# ------------------------------------------------------------------------------------------------------------


def draw(found: dict, folder: Path):
    """The plots: pareto.png, scaling.png, fits.png."""
    for name, plot, size in (('pareto', _pareto, (11, 5)), ('scaling', _scaling, (13, 6)), ('fits', _fits, (11, 4.5))):
        _save(folder / f'{name}.png', plot, found, size)


def _save(path, plot, found, size):
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        fig = Figure(figsize=size, layout='constrained')
        FigureCanvasAgg(fig)
        plot(fig, found)
        fig.savefig(path, dpi=90)


def _pareto(fig, found):
    """Error against time, of images and of derivatives."""
    methods = found['methods']

    def of(start, part=''):
        return [r for r in methods if r['name'].startswith(start) and part in r['name']]

    def last(r):
        return r['name'].split(', ')[-1]

    splat, affine = of('splat'), of('splat', 'affine')
    series = [
        ('splat', [r for r in splat if r not in affine], BLUE, 'o-', last),
        ('splat, affine', affine, RED, 's', None),
        ('every Gaussian on every ray', of('every ray', 'float'), GREEN, '^', last),
        ('grid, exact walk', of('grid', 'exact'), ORANGE, 'D--', lambda r: r['name'].split()[1][:-1]),
        ('grid, steps of 1 voxel', of('grid', 'steps of 1'), GREY, 'x:', None),
        ("Mitsuba's tree, best epsilon", [min(found['marching'][1:], key=lambda r: r['image'])], PURPLE, 'v', None),
    ]
    left, right = fig.subplots(1, 2)
    for axis, time, error, title in (
        (left, 'forward_ms', lambda r: r['image'], 'Image'),
        (right, f'{BACKWARD}_ms', _worst, 'Derivatives, the worst of four'),
    ):
        for label, rows, colour, style, note in series:
            rows = [r for r in rows if time in r]
            x, y = [r[time] for r in rows], [error(r) for r in rows]
            axis.loglog(x, y, style, color=colour, label=label, markersize=6)
            for r, a, b in zip(rows, x, y):
                if note:
                    axis.annotate(note(r), (a, b), textcoords='offset points', xytext=(6, 4), fontsize=8, color=colour)
        axis.margins(x=0.16, y=0.08)
        axis.set(
            title=title,
            xlabel=f'time, {"forward" if axis is left else "with gradients"} [ms]',
            ylabel='relative L2 error',
        )
        axis.grid(alpha=0.3)
    fig.legend(*left.get_legend_handles_labels(), loc='outside lower center', ncols=6)


def _worst(row) -> float:
    """The largest relative error of the four derivatives."""
    return max(row[key] for key in GRADIENTS)


def _scaling(fig, found):
    """Time a pair, of calls and of their kernels alone, and memory, in four sweeps."""
    sweeps = dict(
        pairs=('pairs', 'pairs of a pixel and a Gaussian'),
        small=('pairs', 'the same, small Gaussians'),
        gaussians=('gaussians', 'Gaussians, same pairs'),
        pixels=('side', 'pixels along a side'),
    )
    axes = fig.subplots(2, len(sweeps), sharey='row')
    for column, (sweep, (along, label)) in zip(axes.T, sweeps.items()):
        rows = found['scaling'][sweep]
        x = [r[along] for r in rows]
        for key, memory, colour, name in (
            ('forward', 'memory_mb', BLUE, 'forward'),
            (BACKWARD, 'memory_gradients_mb', RED, 'with gradients'),
        ):
            column[0].loglog(x, [r[f'{key}_ns_per_pair'] for r in rows], 'o-', color=colour, label=name)
            column[0].loglog(
                x, [r[f'{key}_kernels_ns_per_pair'] for r in rows], '--', color=colour, label=f'{name}, kernels alone'
            )
            column[1].loglog(x, [r[memory] for r in rows], 'o-', color=colour)
        for axis in column:
            axis.grid(alpha=0.3)
            axis.set_xlabel(label)
    axes[0, 0].set_ylabel('time a pair [ns]')
    axes[1, 0].set_ylabel('peak memory [MB]')
    axes[0, 0].legend(fontsize=8)


def _fits(fig, found):
    """Quality against seconds while fits run, and of initial clouds."""
    first = found['fits'][0]  # the others are variations of the same
    alike = 'extent', 'side', 'pixels', 'asked', 'values_per_gaussian'
    runs = [r for r in found['fits'] if all(r[key] == first[key] for key in alike)]
    most = max(r['iterations'] for r in runs)
    colours = dict(fast=GREEN, lingo=BLUE, r2=RED)
    for axis, key, title in zip(fig.subplots(1, 2), ('psnr_2d', 'psnr_3d'), ('Held-out views', 'Volume')):
        for r in runs:
            points = [(r['seconds_init'] + h['seconds'], h[key]) for h in r['history']]
            axis.semilogx(*zip(*points), '-', color=colours[r['name']], alpha=1 if r['iterations'] == most else 0.4)
            axis.semilogx(
                *points[-1],
                'o',
                color=colours[r['name']],
                label=f'{r["name"]}, up to {most} iterations' if r['iterations'] == most else None,
            )
        for name, marker in zip(dict.fromkeys(r['name'] for r in found['initialisations']), 'sD^'):
            rows = [r for r in found['initialisations'] if r['name'] == name]
            axis.semilogx(
                [r['seconds'] for r in rows],
                [r[key] for r in rows],
                marker,
                color=ORANGE,
                fillstyle='none',
                label=f'initial cloud, {name}',
            )
        axis.set(title=title, xlabel='time, initial cloud included [s]', ylabel='PSNR [dB]')
        axis.grid(alpha=0.3, which='both')
    axis.legend()
