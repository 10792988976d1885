"""Results side by side: one page with the same slices and views, their differences, numbers, settings and times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, brief
from lingo_mi.files.slabs import plan_and_error_map
from lingo_mi.files.volumes import Volume, read_volume
from lingo_mi.fitting.fit import Fit
from lingo_mi.report import template
from lingo_mi.report.data import quantity_of
from lingo_mi.report.numbers import LISTED, QUALITY, SETTINGS, as_text
from lingo_mi.report.packing import Arrays
from lingo_mi.report.payload import colour_maps, error_maps, slice_payload, view_payload
from lingo_mi.scan import values_digest
from lingo_mi.storage.file_access import as_path, parsed_json

LOWER_IS_BETTER = (
    'residual_rms',
    'residual_to_noise',
    'ipsd',
    'ipsd_reverse',
    'seconds_init',
    'seconds_fit',
    'ms_per_iteration',
)
MOST = 6


@dataclass(frozen=True, eq=False)
class VolumeFile:
    """A volume from a file, such as `lingo-mi reconstruct` writes.

    Parameters
    ----------
    volume : Volume
        Its density.
    error_map : Volume, optional
        Error map from the file V-error.nii.gz beside a volume V.nii.gz, which the algorithm `best` writes.
    """

    volume: Volume
    error_map: Volume | None = None

    @classmethod
    def read(cls, path: Path) -> VolumeFile:
        """The volume, and its map of errors if the plan beside them does not name another volume. Raises InputError."""
        plan, errors = plan_and_error_map(path)
        volume = read_volume(path)
        of_it = errors.exists() and _planned(plan) in (None, values_digest(volume.data))
        return cls(volume, read_volume(errors) if of_it else None)


def _planned(plan: Path) -> str | None:
    """The checksum of the volume that a plan of `best` has made, if there is one that says."""
    try:
        return parsed_json(plan.read_text(encoding='utf-8')).get('volume')
    except (OSError, ValueError, AttributeError):
        return None


def load_result(path: PathLike | str) -> tuple[str, Fit | VolumeFile]:
    """The name and the fit of a folder, or the name and the volume of a file.

    Raises
    ------
    InputError
        If there is neither, a file is damaged, or files do not belong together.
    """
    path = as_path('path', path)
    if path.is_file() or path.name.lower().endswith('.zarr'):
        return path.name.removesuffix('.gz').removesuffix('.zarr').rsplit('.', 1)[0], VolumeFile.read(path)
    return path.resolve().name, Fit.load(path)


def compare_page(results: Sequence[tuple[str, Fit | VolumeFile]], truth: Volume | None = None, title: str = '') -> str:
    """A page, as text, that shows results side by side. Differences are to the truth, or else to the first result.

    Parameters
    ----------
    results : sequence of (str, Fit or VolumeFile)
        2 to 6 results with their names. Volumes must have one grid, and views are shown if their angles and sizes are the same.
    truth : Volume, optional
        The true volume, on the same grid.
    title : str
        Title of the page (default: the names).

    Raises
    ------
    InputError
        For fewer or more results, and for volumes of different grids.

    Examples
    --------
    `compare_page([load_result('out/a'), load_result('out/b')])`
    """
    if not 2 <= len(results) <= MOST:
        raise InputError(f'a comparison is of 2 to {MOST} results, not of {len(results)}')
    names = _names([name for name, _ in results])
    named = dict(zip(names, (result for _, result in results)))
    arrays = Arrays()
    content: dict[str, Any] = dict(colours=colour_maps(), history=[])
    volumes = {name: volume for name, r in named.items() if (volume := _volume(r)) is not None}
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
                    f'{name}: its voxels lie elsewhere than the voxels of {next(iter(volumes))}: results that are compared need '
                    'one grid; fit or reconstruct again with the same scanner'
                )
        middle = first.affine[:3, :3] @ ((np.array(first.data.shape) - 1) / 2) + first.affine[:3, 3]
        data = {name: volume.data for name, volume in volumes.items()}
        content['slices'] = slice_payload(
            data,
            first.spacing,
            middle,
            arrays,
            'Truth' if truth is not None else None,
            quantity=quantity_of(next(iter(data.values())), first.spacing),
        )
        maps = {
            f'Error map: {name}': r.error_map.data
            for name, r in named.items()
            if isinstance(r, VolumeFile) and r.error_map is not None and r.error_map.data.shape == first.data.shape
        }
        if maps:
            content['slices'] |= error_maps(maps, content['slices'], arrays)
    fits = {name: r for name, r in named.items() if isinstance(r, Fit)}
    shown = {name: fit.views for name, fit in fits.items() if fit.views is not None}
    angles = [fits[name].view_angles for name in shown]
    alike = len({images.shape for images in shown.values()}) == 1
    if len(shown) > 1 and alike and all(np.allclose(a, angles[0], atol=1e-3) for a in angles):
        first_shown = next(iter(shown))
        content['views'] = view_payload(
            shown, angles[0], fits[first_shown].nominal_geometry.dDetector, arrays, first_shown
        )
    title = brief(title or ' · '.join(names), 120)
    return template.page(title, f'{len(results)} results side by side', _tables(named), '', content, arrays)


def _volume(result: Fit | VolumeFile) -> Volume | None:
    """The density; None for a method without."""
    if isinstance(result, VolumeFile):
        return result.volume
    if not result.method.makes_volume:
        return None
    geometry = result.nominal_geometry
    affine = np.diag([*geometry.grid.spacing, 1.0])
    affine[:3, 3] = geometry.grid.first_voxel
    return Volume(result.volume(), geometry.grid.spacing, affine, '1/mm')


def _names(wanted: list[str]) -> list[str]:
    """One name for each, that no other has."""
    names: list[str] = []
    for text in wanted:
        name, n = brief(text, 40), 2
        while name in [*names, 'Truth']:
            name, n = f'{brief(text, 36)} ({n})', n + 1
        names.append(name)
    return names


def _grid(volume: Volume) -> str:
    return f'{" x ".join(map(str, volume.data.shape))} voxels of {" x ".join(f"{s:.4g}" for s in volume.spacing)} mm'


def _tables(named: dict[str, Fit | VolumeFile]) -> str:
    metrics = [r.record if isinstance(r, Fit) else {} for r in named.values()]
    settings = [r.method.flat() if isinstance(r, Fit) else {} for r in named.values()]
    head = ('', *named)

    def rows(labels: dict[str, str]):
        return [
            (label, *_cells(key, metrics))
            for key, label in labels.items()
            if any(m.get(key) is not None for m in metrics)
        ]

    out = []
    if quality := rows({key: number.label for key, number in QUALITY.items()}):
        out.append(template.html_table('Quality and cost', quality, 'numbers', head))
    done = rows({key: number.label for key, number in SETTINGS.items()})
    changed = [
        (key, *(as_text('', s.get(key)) for s in settings))
        for key in dict.fromkeys(k for s in settings for k in s)
        if len({repr(s.get(key)) for s in settings if s}) > 1 and key not in SETTINGS
    ]
    if done or changed:
        out.append(template.html_table('What was done, and settings that differ', done + changed, 'numbers', head))
    for name, m in zip(named, metrics):
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
    finite = [v for v in numeric if v is not None]
    compared = key in QUALITY and key not in LISTED
    if not compared or len(finite) < 2:
        return texts
    first = numeric[0]
    for i, value in enumerate(numeric[1:], 1):
        if first is not None and value is not None and value != first:
            texts[i] += f'  ({value - first:+{QUALITY[key].form.lstrip(",")}})'
    if key not in ('gaussians', 'ipsd_targets', 'parameters') and len(set(finite)) > 1:
        best = (min if key in LOWER_IS_BETTER else max)(finite)
        texts = [f'★ {text}' if value == best else text for text, value in zip(texts, numeric)]
    return texts
