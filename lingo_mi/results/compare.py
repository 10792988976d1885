"""Results side by side: one page with the same slices and views, their differences, numbers, settings and times."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, brief
from lingo_mi.files.volumes import Volume
from lingo_mi.report import template
from lingo_mi.report.numbers import LISTED, QUALITY, SETTINGS, as_text
from lingo_mi.report.packing import Arrays
from lingo_mi.report.payload import colour_maps, error_maps, slices, views
from lingo_mi.results.stored import Stored

LOWER_IS_BETTER = 'ipsd', 'ipsd_reverse', 'seconds_init', 'seconds_fit', 'ms_per_iteration'
MOST = 6


def compare_page(results: list[Stored], truth: Volume | None = None, title: str = '') -> str:
    """A page, as text, that shows results side by side. Differences are to the truth, or else to the first result.

    results   2 to 6; volumes must have one grid, and views are shown where they are of the same angles and size
    truth     the true volume, on the same grid

    Raises InputError for fewer or more results, and for volumes of different grids.

        compare_page([read_stored('out/a'), read_stored('out/b')])
    """
    if not 2 <= len(results) <= MOST:
        raise InputError(f'a comparison is of 2 to {MOST} results, not of {len(results)}')
    names = _names(results)
    arrays = Arrays()
    known: dict[str, Any] = dict(colours=colour_maps(), history=[])
    volumes = {name: r.volume for name, r in zip(names, results) if r.volume is not None}
    if truth is not None and volumes:
        volumes['Truth'] = truth
    if volumes:
        first = next(iter(volumes.values()))
        for name, volume in volumes.items():
            if volume.data.shape != first.data.shape or not np.allclose(volume.spacing, first.spacing, rtol=1e-4):
                raise InputError(
                    f'{name}: has {_grid(volume)}, but {next(iter(volumes))} has {_grid(first)}: results that are compared '
                    'need one grid; fit or reconstruct again with the same scanner'
                )
            if name != 'Truth' and not np.allclose(volume.affine, first.affine, atol=0.01 * max(first.spacing)):
                raise InputError(
                    f'{name}: its voxels lie elsewhere than those of {next(iter(volumes))}: results that are compared need '
                    'one grid; fit or reconstruct again with the same scanner'
                )
        middle = first.affine[:3, :3] @ ((np.array(first.data.shape) - 1) / 2) + first.affine[:3, 3]
        data = {name: volume.data for name, volume in volumes.items()}
        known['slices'] = slices(data, first.spacing, middle, arrays, 'Truth' if truth is not None else None)
        maps = {
            f'Error map: {name}': r.error_map.data
            for name, r in zip(names, results)
            if r.error_map is not None and r.error_map.data.shape == first.data.shape
        }
        if maps:
            known['slices'] |= error_maps(maps, known['slices'], arrays)
    shown = {name: r for name, r in zip(names, results) if r.views is not None}
    if len(shown) > 1 and _same_views(list(shown.values())):
        one = next(iter(shown.values()))
        images: dict[str, np.ndarray] = {name: r.views for name, r in shown.items() if r.views is not None}
        pixel = _pixel(one.metrics)
        known['views'] = views(images, one.angles, pixel or (1.0, 1.0), arrays, next(iter(images)))
        if pixel is None:
            known['views']['unit'] = 'pixels'
    title = brief(title or ' · '.join(names), 120)
    return template.page(title, f'{len(results)} results side by side', _tables(names, results), '', known, arrays)


def _pixel(metrics: dict) -> list[float] | None:
    """The size of a detector pixel, (v, u), mm; None where a result does not say, as those of earlier versions."""
    pixel = metrics.get('pixel')
    known = (
        isinstance(pixel, list) and len(pixel) == 2 and all(isinstance(p, float) and 0 < p < math.inf for p in pixel)
    )
    return pixel if known else None


def _names(results: list[Stored]) -> list[str]:
    """One name for each, that no other has."""
    names: list[str] = []
    for result in results:
        name, n = brief(result.name, 40), 2
        while name in [*names, 'Truth']:
            name, n = f'{brief(result.name, 36)} ({n})', n + 1
        names.append(name)
    return names


def _grid(volume: Volume) -> str:
    return f'{" x ".join(map(str, volume.data.shape))} voxels of {" x ".join(f"{s:.4g}" for s in volume.spacing)} mm'


def _same_views(results: list[Stored]) -> bool:
    first = results[0]
    return first.views is not None and all(
        r.views is not None and r.views.shape == first.views.shape and np.allclose(r.angles, first.angles, atol=1e-3)
        for r in results
    )


def _tables(names: list[str], results: list[Stored]) -> str:
    metrics = [r.metrics for r in results]
    head = ('', *names)

    def rows(labels: dict[str, str]):
        return [
            (label, *_cells(key, metrics))
            for key, label in labels.items()
            if any(m.get(key) is not None for m in metrics)
        ]

    out = []
    if quality := rows({key: number.label for key, number in QUALITY.items()}):
        out.append(template.table('Quality and cost', quality, 'numbers', head))
    done = rows({key: number.label for key, number in SETTINGS.items()})
    settings: list[dict] = [m['settings'] if isinstance(m.get('settings'), dict) else {} for m in metrics]
    changed = [
        (key, *(as_text('', s.get(key)) for s in settings))
        for key in dict.fromkeys(k for s in settings for k in s)
        if len({repr(s.get(key)) for s in settings if s}) > 1 and key not in SETTINGS
    ]
    if done or changed:
        out.append(template.table('What was done, and settings that differ', done + changed, 'numbers', head))
    for name, m in zip(names, metrics):
        if m.get('command'):
            out.append(template.code(f'Make {name} again', str(m['command'])))
    return '\n'.join(out)


def _cells(key: str, metrics: list[dict]) -> list[str]:
    """The values of a number; the best is marked, and of the others the difference to the first is said."""
    values = [m.get(key) for m in metrics]
    texts = [as_text(key, value) for value in values]
    numeric = [
        v if isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) else None for v in values
    ]
    known = [v for v in numeric if v is not None]
    compared = key in QUALITY and key not in LISTED
    if not compared or len(known) < 2:
        return texts
    first = numeric[0]
    for i, value in enumerate(numeric[1:], 1):
        if first is not None and value is not None and value != first:
            texts[i] += f'  ({value - first:+{QUALITY[key].form.lstrip(",")}})'
    if key not in ('gaussians', 'ipsd_targets', 'parameters') and len(set(known)) > 1:
        best = (min if key in LOWER_IS_BETTER else max)(known)
        texts = [f'★ {text}' if value == best else text for text, value in zip(texts, numeric)]
    return texts
