"""Explanation of a measured scan's error: corrections are added one after another and judged by held-out views.

`calibrate` finds all numbers at once from the views that are kept. Then each row of the table takes one more kind of them,
reconstructs those views, and predicts the others, whose corrections are those for their time. The prediction is compared with
what was measured as it is, so that no row is favoured by a change of the data. The last row has no error of measurement at all:
what all views reconstruct is taken for the object, and scanned with the noise of the scan's air. It tells what so few views leave
in any case.

A row is stored when it is done, and not computed again for the same scan and numbers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.api.calibration import calibrate
from lingo_mi.api.fitting import fit
from lingo_mi.calibration.calibration import Calibration
from lingo_mi.calibration.drift import Drift
from lingo_mi.inspection.air import air_of
from lingo_mi.projectors import grid
from lingo_mi.raw.line_integrals import photons_of_images
from lingo_mi.reconstruction import ASDPOCS, OSSART, run_algorithm
from lingo_mi.scan import Dataset, Scan
from lingo_mi.storage.file_access import replacing, write_text
from lingo_mi.validation.markdown import table
from lingo_mi.validation.provenance import write_provenance
from studies.cell_files import CellFiles

DRIFT = 3
AIR = 'air level'
# What a row adds -> how the names of its numbers begin.
ROWS = {
    'as given': (),
    'axis and turn of the panel': ('u', 'yaw'),
    'drift': ('u1', 'u2', 'u3', 'v1', 'v2', 'v3'),
    AIR: ('air',),
    'gain': ('gain',),
    'curve': ('curve',),
    'scatter': ('scatter',),
}
NOTHING = 'no error of measurement (simulated)'
# Corrections that a fit finds with the cloud, besides those of the rows above.
WITH_CLOUD = {
    'as given': {},
    'air level of every view': dict(fit_air='view'),
    'poses, every view for itself': dict(rate_pose=(2e-3, 2e-4)),
    'poses, smooth in time': dict(rate_pose=(2e-3, 2e-4), pose_motion='smooth'),
}


@dataclass(frozen=True)
class Explained:
    """A row: rms difference of held-out views, and their picture.

    Parameters
    ----------
    rms : float
        Root mean square of the difference, in line integrals.
    view : ndarray
        A held-out view's difference, float32 [v, u].
    """

    name: str
    rms: float
    view: np.ndarray


def binned(dataset: Dataset, factor: int) -> Dataset:
    """Both scans with `factor` x `factor` pixels as one, on voxels as much wider."""
    if factor == 1 or dataset.test is None:
        return dataset

    def of(scan):
        grid = scan.geometry.grid
        return scan.binned(factor).on(grid.resized([max(1, n // factor) for n in grid.shape]))

    return Dataset(of(dataset.train), of(dataset.test))


def rows(
    dataset: Dataset, calibration: Calibration, folder: Path, progress: Callable[[str], None] = print
) -> Iterable[Explained]:
    """The table's rows on voxels, by ASD-POCS, stored below `folder`. The calibration is of `dataset.train`."""
    numbers, names, stored = calibration.found.measured, set(), _Stored(folder, 'corrected', dataset)
    air, read = None, {}  # read beside the object, and subtracted from its row on
    for name, prefixes in ROWS.items():
        if name == AIR and calibration.air is not None:
            air = calibration.air
            read = dict(read=air.levels.tolist())
        more = {k for k in numbers if k in prefixes or k.rstrip('0123456789_') in prefixes and k[0] not in 'uvy'}
        if prefixes and not more and not (name == AIR and air):
            continue
        names |= more
        progress(name)
        some = {k: numbers[k] for k in sorted(names)}
        yield stored.row(name, some | read, lambda: _judged(name, dataset, _with(calibration, some, air)))
    progress(NOTHING)
    yield stored.row(NOTHING, {}, lambda: _judged(NOTHING, _ideal(dataset), _with(calibration, {}, None)))


def cloud_rows(
    dataset: Dataset, folder: Path, progress: Callable[[str], None] = print, **options
) -> Iterable[Explained]:
    """Rows of fits that find the corrections with the cloud, stored below `folder`."""
    test, stored = dataset.test, _Stored(folder, 'with_the_cloud', dataset)
    assert test is not None  # what rows are judged by

    def fitted(name, changes):
        result = fit(dataset.train, 'fast', progress=False, **changes)
        return _row(name, test, result.expected(test.geometry))

    for name, changes in WITH_CLOUD.items():
        progress(name)
        chosen = options | changes
        yield stored.row(name, chosen, lambda: fitted(name, chosen))


def report(rows: list[Explained], folder: Path, title: str) -> str:
    """Write rms.json, rms.md with its provenance and residuals.png; returns the table."""
    folder.mkdir(parents=True, exist_ok=True)
    text = table([(title, lambda r: r.name), ('held-out views, rms', lambda r: f'{r.rms:.5f}')], rows)
    write_text(folder / 'rms.json', json.dumps({r.name: r.rms for r in rows}, indent=1) + '\n')
    write_text(folder / 'rms.md', text + '\n')
    write_provenance(folder / 'rms.md')
    _draw(rows, folder / 'residuals.png')
    return text


def find(dataset: Dataset, kinds: Iterable[str]) -> Calibration:
    """The numbers of a scan: the panel's axis and turn, and of drift, air, gain, curve and scatter those named."""
    asked = set(kinds)
    return calibrate(
        dataset.train,
        drift=DRIFT if 'drift' in asked else 0,
        air='air' in asked,
        gain='gain' in asked,
        curve=int('curve' in asked),
        scatter='scatter' in asked and dataset.train.geometry.grid.shape[2] > 1,
    )


class _Stored:
    """The rows of a table of a scan, in a folder of its name."""

    def __init__(self, folder: Path, table: str, dataset: Dataset):
        assert dataset.test is not None  # what rows are judged by
        self.cells, self.table = CellFiles(folder, 'of', 'rms', 'view'), table
        self.scans = f'{dataset.train.digest()} {dataset.test.digest()}'

    def row(self, name: str, settings: dict, compute: Callable[[], Explained]) -> Explained:
        """The row of this name, computed unless it is stored and was made with these numbers or options."""
        of, place = f'{self.scans} {json.dumps(settings)}', name.replace(' ', '_')
        stored: dict[str, Any] | None = self.cells.get(self.table, place)
        if stored is None or stored['of'] != of:
            row = compute()
            stored = dict(of=of, rms=row.rms, view=row.view.tolist())
            self.cells.put(self.table, place, stored)
        return Explained(name, stored['rms'], np.array(stored['view'], np.float32))


def _with(calibration, numbers, air):
    """A calibration with these numbers, and this air read beside the object, alone."""
    result = calibration.found
    places = {k: v for k, v in numbers.items() if k[0] in 'uvy'}
    response = None if result.response is None else result.response.changed(numbers)
    return replace(
        calibration, air=air, found=replace(result, drift=Drift.of(result.drift.scan, places), response=response)
    )


def _judged(name, dataset, calibration):
    corrected = calibration.corrected(dataset)
    volume = run_algorithm(corrected.train, ASDPOCS()).volume
    expected = grid.project_volume(volume, corrected.test.geometry)
    if calibration.found.response is not None:
        expected = calibration.found.response.applied(expected, dataset.test.geometry)
    level = None if calibration.air is None else air_of(dataset.test)
    return _row(name, dataset.test, expected if level is None else expected + level.image(expected.shape[1:]))


def _row(name, test, expected):
    difference = test.projections - expected
    inside = np.ones(difference.shape, bool) if test.valid is None else test.valid
    return Explained(name, float(np.sqrt(np.square(difference[inside]).mean())), difference[0])


def _ideal(dataset):
    """The scan of what all its views reconstruct, with its noise in air."""
    g, n = dataset.train.geometry, len(dataset.train)
    scans = dataset.train, dataset.test
    valid = np.concatenate([np.ones(s.projections.shape, bool) if s.valid is None else s.valid for s in scans])
    every = Scan(g.joined(dataset.test.geometry), np.concatenate([s.projections for s in scans]), valid)
    order = np.argsort(every.geometry.angles)
    volume = run_algorithm(every.subset(order), OSSART(niter=10, blocksize=4)).volume
    p = grid.project_volume(volume, every.geometry)
    photons = photons_of_images(every.projections, every.valid)
    if np.isfinite(photons):
        rng = np.random.default_rng(0)
        p = p + rng.normal(size=p.shape).astype(np.float32) * np.sqrt(np.exp(p) / photons).astype(np.float32)
    clean = Scan(every.geometry, p, every.valid)
    return Dataset(clean.subset(slice(0, n)), clean.subset(slice(n, None)))


def _draw(rows, path):
    """The differences in one held-out view, row by row of the table, on one scale."""
    from matplotlib.figure import Figure  # half a second that reconstructions need not wait for

    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    height, width = rows[0].view.shape
    flat = height < width / 8  # a row of a fan beam is drawn as a curve
    figure = Figure(
        figsize=(3.2 * columns, (1.8 if flat else 3.2 * height / width + 0.5) * lines), layout='constrained'
    )
    limit = float(np.percentile(np.abs(rows[0].view), 99))
    for k, row in enumerate(rows):
        axes = figure.add_subplot(lines, columns, k + 1)
        if flat:
            axes.plot(row.view.mean(0), linewidth=0.8)
            axes.set(ylim=(-2 * limit, 2 * limit), xticks=[])
        else:
            axes.imshow(row.view, cmap='RdBu', vmin=-limit, vmax=limit)
            axes.set(xticks=[], yticks=[])
        axes.set_title(f'{row.name}\n{row.rms:.5f}', fontsize=8)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=90, format='png')
