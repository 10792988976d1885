"""Volumes of one scan by this package and by its neighbours, compared without a known truth.

Every method reconstructs from a few of the measured views. Its volume is measured by what it predicts of the views that are left
(exact line integrals of its trilinear interpolant), and against a reference: the true volume, or the FDK of all views.

A cell is one method on so many views: its numbers as JSON, written atomically, and its volume as NIfTI beside it. A stored cell
is not computed again.

    study = Study(dataset, Path('out/peers'))
    study.compute_missing(['fdk', 'best', 'rtk-tv'], [15, 30])
    print(study.table(['fdk', 'best', 'rtk-tv'], [15, 30]))
"""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import parse
from lingo_mi.common.runtime import cores
from lingo_mi.files.volumes import read_volume
from lingo_mi.fitting.loop import run as fit
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.geometry.grid import Grid
from lingo_mi.metrics.quality import psnr_3d
from lingo_mi.projectors import grid
from lingo_mi.reconstruction import ASDPOCS, FDK, SART, Best, Reconstruction, Refined
from lingo_mi.reconstruction.held_out import split_views
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.voxel_values import means
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.simulate import choose_views
from lingo_mi.storage.file_access import replacing, write_text
from lingo_mi.validation.provenance import provenance
from studies.benchmarks import mbirjax_bridge, rtk_bridge
from studies.cell_files import CellFiles

REFERENCE = 'reference'
ACROSS = 5  # slices side by side in the picture


def _cloud(scan: Scan) -> Callable[[Grid], np.ndarray]:
    """A function that samples a fitted cloud."""
    return fit(scan, Fast()).volume


def _refined(scan: Scan) -> np.ndarray:
    """For objects finer than the voxels, as measured ones are (docs/how_to/few_views.md)."""
    return run_algorithm(scan, Refined(finer=2, completed_niter=0, niter=4), sample=_cloud(scan)).volume


def _itk() -> Any:
    itk = importlib.import_module('itk')
    itk.RTK  # noqa: B018 - loads it
    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(cores())
    return itk


def _rtk_tv(scan: Scan, beta: float) -> np.ndarray:
    return rtk_bridge.total_variation(scan, _itk(), beta)


def _qggmrf(scan: Scan, sharpness: float) -> np.ndarray:
    """Densities are not negative, as for SART and ASD-POCS."""
    return mbirjax_bridge.reconstruct(scan, _mbirjax(), sharpness=sharpness, positivity_flag=True)


def _wrong(volume: np.ndarray, held_out: Scan) -> float:
    """Root mean square error of a volume's projections over the valid pixels of views. The voxels may be smaller ones."""
    held_out = held_out.on(held_out.geometry.grid.finer(_finer(volume, held_out)))
    wrong = (grid.project_volume(volume, held_out.geometry) - held_out.projections).astype(float)
    return float(np.sqrt(np.mean(np.square(wrong if held_out.valid is None else wrong[held_out.valid]))))


def _finer(volume: np.ndarray, scan: Scan) -> int:
    """Return the number of voxels of the volume that are as wide as one voxel of the scan."""
    return volume.shape[0] // scan.geometry.grid.shape[0]


def _mbirjax() -> Any:
    os.environ.setdefault(
        'MBIRJAX_NUM_CPU_DEVICES', '1'
    )  # one device with all cores: as many devices as cores are slower
    return importlib.import_module('mbirjax')


@dataclass(frozen=True)
class Method:
    """A way to reconstruct a scan.

    Parameters
    ----------
    label : str
        In the table.
    volume : callable
        The volume [x, y, z] of a scan, or of a scan and a value of the setting.
    setting : str
        Chosen by held-out views among `values`, because no value is good for every scan.
    """

    label: str
    volume: Callable[..., np.ndarray]
    setting: str = ''
    values: Sequence[float] = ()

    def run(self, scan: Scan) -> tuple[np.ndarray, dict[str, float]]:
        """The volume of a scan, and the setting by name with the value that predicts one view in five best from the others."""
        if not self.setting:
            return self.volume(scan), {}
        value = self.values[0]
        if len(self.values) > 1:
            train, held_out = split_views(scan, 5)
            value = min(self.values, key=lambda value: self._miss(train, value, held_out))
        return self.volume(scan, value), {self.setting: value}

    def _miss(self, train: Scan, value: float, held_out: Scan) -> float:
        volume = self.volume(train, value)
        return _wrong(volume, held_out) if np.isfinite(volume).all() else np.inf  # a peer may diverge


METHODS = {
    'fdk': Method('FDK', lambda scan: run_algorithm(scan, FDK()).volume),
    'sart': Method('SART', lambda scan: run_algorithm(scan, SART()).volume),
    'asd-pocs': Method('ASD-POCS', lambda scan: run_algorithm(scan, ASDPOCS()).volume),
    'rtk-tv': Method('RTK, total variation', _rtk_tv, 'beta', (1.0, 3.0, 10.0, 30.0)),
    'mbirjax': Method('MBIRJAX', _qggmrf, 'sharpness', (0.0, 1.0, 2.0, 3.0)),
    'fast': Method("`fast`, the cloud's volume", lambda scan: _cloud(scan)(scan.geometry.grid)),
    'refined': Method('`fast`, then `refined`, `finer=2`', _refined),
    'best': Method('`best`', lambda scan: run_algorithm(scan, Best()).volume),
    'best-values': Method("`best`, `voxels='values'`", lambda scan: run_algorithm(scan, Best(voxels='values')).volume),
    'best-finer': Method("`best`, `voxels='finer'`", lambda scan: run_algorithm(scan, Best(voxels='finer')).volume),
}
NEEDS = {
    'rtk-tv': (_itk, "RTK: pip install -e '.[reference]'"),
    'mbirjax': (_mbirjax, "MBIRJAX: pip install -e '.[reference]'"),
}


def method_of(name: str) -> Method:
    """The method of a name; `mbirjax:1` has that value of its setting.

    Raises
    ------
    InputError
        For an unknown one.
    """
    kind, _, value = name.partition(':')
    method = METHODS.get(kind)
    if method is None or value and not method.setting:
        names = [*METHODS, *(f'{name}:{method.setting.upper()}' for name, method in METHODS.items() if method.setting)]
        raise InputError(f'--methods {name}: is unknown; use some of {", ".join(names)}')
    if not value:
        return method
    number = parse(f'--methods {name}', value, 0.0)
    if not np.isfinite(number):
        raise InputError(f'--methods {name}: the {method.setting} must be finite')
    return replace(method, label=f'{method.label}, {method.setting} {number:g}', values=(number,))


def installed(names: Iterable[str], say: Callable[[str], object]) -> list[str]:
    """The methods that can run here; `say` is called with a line for each that cannot.

    Raises
    ------
    InputError
        If none can.
    """
    available = []
    for name in names:
        load, what = NEEDS.get(name.partition(':')[0], (None, ''))
        try:
            if load:
                load()
            available.append(name)
        except (ImportError, AttributeError):
            say(f'{name}: left out, it needs {what}')
    if not available:
        raise InputError('none of the --methods is installed')
    return available


class Study:
    """The cells of one scan below a folder.

    `compute_missing` raises InputError if the folder has the cells of another scan, and where there is nothing to compare
    with. A method that refuses the scan is left out, with a line that says why.

    Parameters
    ----------
    dataset : Dataset
        All measured views to choose from, and the true volume, if known.
    """

    def __init__(self, dataset: Dataset, folder: Path):
        self.dataset, self.folder = dataset, Path(folder)
        self.cells = CellFiles(folder, 'held_out_rms', 'psnr_3d', 'seconds')

    def compute_missing(
        self, methods: Iterable[str], views: Iterable[int], say: Callable[[str], object] = lambda line: None
    ) -> None:
        """Compute and store the cells that are missing: of every number of views, every method."""
        methods = list(methods)
        self._require_same_scan()
        self.reference()
        for count in views:
            chosen = choose_views(self.dataset, count)
            for method in methods:
                if self.get(count, method) is None:
                    try:
                        cell = self._compute(chosen, method)
                    except InputError as error:
                        say(f'{count} views, {method}: left out: {error}')
                        continue
                    self.cells.put(_case(count), _file(method), cell)
                    text = ', '.join([method, *(f'{name} {value:g}' for name, value in cell['settings'].items())])
                    say(
                        f'{count} views, {text}: rms {cell["held_out_rms"]:.4f}, {cell["psnr_3d"]:.2f} dB, '
                        f'{cell["seconds"]:.0f} s'
                    )

    def _require_same_scan(self) -> None:
        scans = [scan for scan in (self.dataset.train, self.dataset.test) if scan is not None]
        path, digest = self.folder / 'scan.txt', ' '.join(scan.digest() for scan in scans)
        if path.exists() and path.read_text(encoding='utf-8').strip() != digest:
            raise InputError(f'{self.folder}: has the volumes of another scan; choose another --out')
        self.folder.mkdir(parents=True, exist_ok=True)
        write_text(path, digest + '\n')

    def get(self, views: int, method: str) -> dict | None:
        """A stored cell, or None if there is none that can be read."""
        return self.cells.get(_case(views), _file(method))

    def volume(self, views: int, method: str) -> np.ndarray:
        """The volume [x, y, z] of a stored cell."""
        return read_volume(self._volume_path(_case(views), method)).data

    def reference(self) -> np.ndarray:
        """The volume [x, y, z] that all are compared with."""
        if self.dataset.volume is not None:
            return self.dataset.volume
        path = self.folder / f'{REFERENCE}.nii.gz'
        if not path.exists():
            run_algorithm(self.dataset.train, FDK(fill=False)).save(path)  # a reference is measured everywhere
        return read_volume(path).data

    def _compute(self, chosen: Dataset, method: str) -> dict:
        assert chosen.test is not None  # the views that were not chosen
        began, processor = time.perf_counter(), time.process_time()
        volume, settings = method_of(method).run(chosen.train)
        seconds, processor = time.perf_counter() - began, time.process_time() - processor
        finer = _finer(volume, chosen.train)
        Reconstruction(volume, [], seconds, chosen.train.geometry.grid.finer(finer)).save(
            self._volume_path(_case(len(chosen.train)), method), force=True
        )
        return dict(
            views=len(chosen.train),
            method=method,
            settings=settings,
            held_out_rms=_wrong(volume, chosen.test),
            psnr_3d=psnr_3d(means(volume, finer), self.reference()),
            seconds=seconds,
            processor_seconds=processor,
            provenance=provenance(),
        )

    def _volume_path(self, case: str, method: str) -> Path:
        return self.folder / case / f'{_file(method)}.nii.gz'

    def table(self, methods: Sequence[str], views: Iterable[int]) -> str:
        """The Markdown table of the cells that are there, a row a method of every number of views."""
        lines = ['| views | method | held-out rms | volume, dB | s | processor s |', '|---:|---|---:|---:|---:|---:|']
        for count in views:
            cells = {method: cell for method in methods if (cell := self.get(count, method))}
            least = min((cell['held_out_rms'] for cell in cells.values()), default=0.0)
            for method, cell in cells.items():
                rms = f'{cell["held_out_rms"]:.4f}'
                lines.append(
                    f'| {count} | {method_of(method).label} | {f"**{rms}**" if cell["held_out_rms"] == least else rms} '
                    f'| {cell["psnr_3d"]:.2f} | {cell["seconds"]:.0f} | {cell["processor_seconds"]:.0f} |'
                )
        return '\n'.join(lines)

    def draw(self, methods: Sequence[str], views: Sequence[int], path: Path) -> None:
        """Picture of the middle slice across z, of every number of views: the reference, then the methods."""
        from matplotlib.figure import Figure  # half a second that a study need not wait for

        reference = self.reference()
        middle = reference.shape[2] // 2
        top = float(np.quantile(reference[:, :, middle], 0.995))
        slices = 1 + len(methods)
        columns, rows = min(slices, ACROSS), -(-slices // ACROSS)
        figure = Figure(figsize=(2.4 * columns, 2.6 * rows * len(views)), layout='constrained')
        axes = figure.subplots(rows * len(views), columns, squeeze=False)
        for axis in axes.flat:
            axis.axis('off')
        for block, count in zip(np.split(axes, len(views)), views):
            shown = [('reference', reference)]
            for name in methods:
                if self.get(count, name) is not None:
                    shown.append((f'{method_of(name).label.replace("`", "")}, {count} views', self.volume(count, name)))
            for axis, (title, volume) in zip(block.flat, shown):
                axis.imshow(volume[:, :, volume.shape[2] // 2].T, cmap='gray', vmin=0, vmax=top, origin='lower')
                axis.set_title(title, fontsize=9)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=110)


def _case(views: int) -> str:
    return f'{views}_views'


def _file(method: str) -> str:
    return method.replace(':', '_')
