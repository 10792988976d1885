"""Markdown tables of the results of `accuracy.measure`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.projectors.cutoff import PRESETS
from lingo_mi.storage.file_access import reading
from lingo_mi.validation.closed_form import NAMES
from lingo_mi.validation.markdown import table

BACKWARD = 'gradients'

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
    field='Neural fields',
)
SHOWN = 'conditions', 'presets'  # shown in the page of the documentation, which links to the others as data


def make_tables(results: dict, beside: dict | None = None) -> dict[str, str]:
    """Markdown tables by the names of TITLES; presets alone have their own table.

    Parameters
    ----------
    beside : dict or None
        Another variant's presets, `read_presets`, whose errors are shown beside.
    """
    presets = preset_table(results, beside)
    if 'methods' not in results:
        return dict(presets=presets)
    first = dict(
        cutoff='cut-off, σ',
        footprint='footprint',
        methods='method',
        marching='method',
        pixel='rays a pixel',
        teams='shares, of the usual number',
    )
    tables = {name: table(_COMPARE, results[name], title) for name, title in first.items()}
    wrong = ('wrong rays', lambda r: f'{100 * r["wrong_rays"]:.2g} %')
    tables['marching'] = table([_COMPARE[0], wrong, *_COMPARE[1:]], results['marching'], first['marching'])
    tables['conditions'] = conditions(results['conditions'])
    tables['presets'] = presets
    tables['scaling'] = table(
        _SCALING, [dict(row, sweep=sweep) for sweep, rows in results['scaling'].items() for row in rows]
    )
    tables['initialisations'] = table(_INITIAL, results['initialisations'])
    tables['fits'] = table(_FITS, results['fits'])
    tables['field'] = table(FIELD, results['field'])
    return {name: tables[name] for name in TITLES}


def conditions(c: dict) -> str:
    """Describe the conditions of the measurements in a sentence."""
    s = c['sizes']
    return (
        f'`{c["variant"]}` on {c["threads"]} threads of {c["machine"]}. Unless a table says otherwise, it has '
        f'{s["gaussians"]:,} Gaussians ({s["few"]:,} where other methods are compared, {s["few"] // 2:,} for pixels), '
        f'{s["pixels"]} × {s["pixels"]} pixels, {s["box"]:g} pixels in the box of a Gaussian at 3 σ, and '
        f'medians of up to {s["rounds"]} rounds ± half the interquartile range.'
    )


def preset_table(results: dict, beside: dict | None = None) -> str:
    """The table of the presets. beside   see `make_tables`"""
    columns, rows = list(_PRESETS), preset_rows(results['cutoff'])
    if beside:
        title = beside['conditions']['variant'].split('_')[0].upper()
        for row, other in zip(rows, preset_rows(beside['cutoff'])):
            row.update(other_image=other['image'], other_worst=max(other[key] for key in NAMES))
        # Before the times, which belong to the first variant alone.
        columns[-2:-2] = [(f'image, L2, {title}', _error('other_image')), (f'worst ∂, {title}', _error('other_worst'))]
    return table(columns, rows)


def read_presets(path: Path) -> dict:
    """The accuracy.json of another run.

    Raises
    ------
    InputError
        If it is none, or lacks a preset.
    """
    with reading(path):
        text = Path(path).read_text(encoding='utf-8')
    try:
        presets = json.loads(text)
        preset_table(presets, presets)
    except (ValueError, TypeError, KeyError, AttributeError):
        raise InputError(f'{path}: holds no presets; write it with lingo-mi accuracy --presets') from None
    return presets


def preset_rows(cutoff: list[dict]) -> list[dict]:
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
    return f'{max(row[f"{key}_max"] for key in NAMES):.1e}' if 'centre_max' in row else '–'


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
    *((f'∂ {key}', _error(key)) for key in NAMES),
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
    *((f'∂ {key}', _error(key)) for key in NAMES),
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
_QUALITY = [('views, dB', _number('psnr_2d', '{:.2f}')), ('volume, dB', _number('psnr_3d_r2', '{:.2f}'))]
_INITIAL = [
    ('initial cloud', _number('name', '{}')),
    ('Gaussians', _number('points', '{:,}')),
    ('seconds', _number('seconds', '{:.2f}')),
    ('IPSD', _number('ipsd', '{:.3f}')),
    *_QUALITY,
]
_FITS = [
    ('method', _number('name', '{}')),
    ('phantom', _number('side', '{0}³')),
    ('panel', _number('pixels', '{0}²')),
    ('iterations', _number('iterations', '{:,}')),
    ('Gaussians, first', _number('points', '{:,}')),
    ('last', _number('gaussians', '{:,}')),
    ('cut-off, σ', _number('extent', '{:g}')),
    ('seconds', _number('seconds', '{:.1f}')),
    *_QUALITY,
]
FIELD = [
    ('samples on a ray', _number('name', '{}')),
    ('L2', _error('image')),
    ('max', _error('image_max')),
    ('L2, at random', _error('random')),
    ('µs of CPU a ray', _number('us_per_ray', '{:.3g}')),
    ('ms of CPU to sample the volume', _number('sampling', '{:.0f}')),
]
