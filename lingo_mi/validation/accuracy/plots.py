"""Plots of the results of `accuracy.measure`."""

from __future__ import annotations

from pathlib import Path

from lingo_mi.report.figures import STYLE
from lingo_mi.storage.file_access import replacing
from lingo_mi.validation.accuracy.tables import BACKWARD
from lingo_mi.validation.closed_form import NAMES

RED, BLUE, GREEN, ORANGE, GREY, PURPLE = 'tab:red', 'tab:blue', 'tab:green', 'tab:orange', 'tab:gray', 'tab:purple'


def draw(results: dict, folder: Path) -> None:
    """Write the plots into a folder: pareto.png, scaling.png, fits.png."""
    for name, plot, size in (('pareto', _pareto, (11, 5)), ('scaling', _scaling, (13, 6)), ('fits', _fits, (11, 4.5))):
        _save(folder / f'{name}.png', plot, results, size)


def _save(path, plot, results, size):
    from matplotlib import rc_context  # half a second that measuring need not wait for
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        fig = Figure(figsize=size, layout='constrained')
        plot(fig, results)
        with replacing(path) as temporary:
            fig.savefig(temporary, dpi=90)


def _pareto(fig, results):
    """Error against time, of images and of derivatives."""
    methods = results['methods']

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
        ("Mitsuba's tree, best epsilon", [min(results['marching'][1:], key=lambda r: r['image'])], PURPLE, 'v', None),
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
    return max(row[key] for key in NAMES)


def _scaling(fig, results):
    """Time a pair, of calls and of their kernels alone, and memory, in four sweeps."""
    sweeps = dict(
        pairs=('pairs', 'pairs of a pixel and a Gaussian'),
        small=('pairs', 'the same, small Gaussians'),
        gaussians=('gaussians', 'Gaussians, same pairs'),
        pixels=('side', 'pixels along a side'),
    )
    axes = fig.subplots(2, len(sweeps), sharey='row')
    for column, (sweep, (along, label)) in zip(axes.T, sweeps.items()):
        rows = results['scaling'][sweep]
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


def _fits(fig, results):
    """Quality against seconds while fits run, and of initial clouds."""
    first = results['fits'][0]  # the others are variations of the same
    alike = 'extent', 'side', 'pixels', 'asked', 'values_per_gaussian'
    runs = [r for r in results['fits'] if all(r[key] == first[key] for key in alike)]
    most = max(r['iterations'] for r in runs)
    colours = dict(fast=GREEN, lingo=BLUE, r2=RED)
    axes = fig.subplots(1, 2)
    for axis, key, title in zip(axes, ('psnr_2d', 'psnr_3d_r2'), ('Held-out views', 'Volume')):
        for r in runs:
            points = [(r['seconds_init'] + h['seconds'], h[key]) for h in r['history']]
            axis.semilogx(*zip(*points), '-', color=colours[r['name']], alpha=1 if r['iterations'] == most else 0.4)
            axis.semilogx(
                *points[-1],
                'o',
                color=colours[r['name']],
                label=f'{r["name"]}, up to {most} iterations' if r['iterations'] == most else None,
            )
        for name, marker in zip(dict.fromkeys(r['name'] for r in results['initialisations']), 'sD^'):
            rows = [r for r in results['initialisations'] if r['name'] == name]
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
    axes[1].legend()
