"""Distance between `Best`, which does not know the truth, and the best fixed settings, chosen by the truth.

A cell is one setting on one scan: a JSON file, written atomically. A stored cell is not computed again.

    study = Study(Path('out/regret'))
    study.compute_missing([Case('foot', finer=2, views=25)], clouds=False)
    print(study.table([Case('foot', finer=2, views=25)]))
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.stats import spearmanr

from lingo_mi.common.errors import InputError
from lingo_mi.completion.prepare import fit_cloud
from lingo_mi.completion.views import insert_views
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run as fit
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.geometry.grid import Grid
from lingo_mi.metrics.quality import psnr_3d
from lingo_mi.reconstruction import ASDPOCS, FDK, Best, Refined
from lingo_mi.reconstruction.best import LONG, SPREAD, Chosen, refine
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.voxel_values import means
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.shipped import scene_path
from lingo_mi.scene.simulate import choose_views
from lingo_mi.validation.provenance import provenance
from lingo_mi.validation.tables.photons import counting, noisy
from studies.cell_files import CellFiles
from studies.simulated import simulated

COMPLETED = 100  # views
MEASURED = 'walnut', 'htc2022'  # scenes of measured views; their reference is the FDK of all of them
BEST = 'best'
VOXELS = {'asd-pocs': 'ASD-POCS', 'refined': 'refined from ASD-POCS', 'refined_finer': 'the same, half the size'}
CLOUDS = {
    'cloud': "cloud's volume",
    'completed': 'ASD-POCS, completed',
    'cloud_refined': 'refined from the cloud',
    'cloud_finer': 'the same, half the size',
}
BEST_CLOUD = 'best_cloud'  # `Best(cloud=True)`


@dataclass(frozen=True)
class Case:
    """A scan.

    Parameters
    ----------
    object : str
        One of `lingo_mi.validation.tables.objects`, scanned over a full turn; or one of MEASURED.
    finer : int
        How many times as many voxels are scanned along each side.
    views : int
        Reconstructed from.
    photons : float
        A pixel in the open beam; 0: no noise.
    """

    object: str
    finer: int = 1
    views: int = 25
    photons: float = 0.0


class Study:
    """The cells of one size below a folder: volumes of `size` voxels along the longest side, panels of 5/3 as many pixels."""

    def __init__(self, folder: Path, size: int = 48):
        self.size, self.cells = size, CellFiles(folder, 'psnr_3d', 'seconds')
        self.dataset = functools.lru_cache(1)(self._dataset)
        self._cloud = functools.lru_cache(1)(self._fitted)

    def name(self, case: Case) -> str:
        return f'{case.object}_{self.size}_x{case.finer}_{case.views}_views_{case.photons:.17g}_photons'

    def get(self, case: Case, setting: str) -> dict | None:
        """A stored cell, or None if there is none that can be read."""
        return self.cells.get(self.name(case), setting)

    def compute_missing(
        self, cases: Iterable[Case], clouds: bool, say: Callable[[str], object] = lambda line: None
    ) -> None:
        """Compute and store the cells that are missing. `clouds`: also the settings that need a fitted cloud, minutes a case."""
        for case in cases:
            for setting in [*VOXELS, BEST, *((*CLOUDS, BEST_CLOUD) if clouds else ())]:
                if self.get(case, setting) is None:
                    cell = self._compute(case, setting)
                    self.cells.put(self.name(case), setting, cell)
                    say(f'{case}, {setting}: {cell["psnr_3d"]:.2f} dB, {cell["seconds"]:.1f} s')

    def _compute(self, case: Case, setting: str) -> dict:
        dataset = self.dataset(case)
        assert dataset.volume is not None
        if setting in CLOUDS:
            self._cloud(case)  # not in this setting's time, but in its sum
        began, extra = time.process_time(), {}
        if setting in (BEST, BEST_CLOUD):
            result = run_algorithm(dataset.train, Best(cloud=setting == BEST_CLOUD), fit=fit_cloud)
            assert isinstance(result, Chosen) and result.error is not None
            volume = result.volume
            wrong = np.sqrt(gaussian_filter((volume - dataset.volume) ** 2, SPREAD))
            extra = dict(
                plan=result.record(), error_map=float(np.asarray(spearmanr(result.error.ravel(), wrong.ravel()))[0])
            )
        else:
            volume = self._volume(case, dataset.train, setting)
        seconds = time.process_time() - began + (self._cloud(case)[1] if setting in CLOUDS else 0.0)
        dB = psnr_3d(volume, dataset.volume)
        return dict(
            asdict(case), setting=setting, psnr_3d=dB, seconds=seconds, size=self.size, provenance=provenance(), **extra
        )

    def _volume(self, case: Case, scan: Scan, setting: str) -> np.ndarray:
        if setting == 'asd-pocs':
            return run_algorithm(scan, ASDPOCS()).volume
        if setting in VOXELS:
            finer = 2 if setting == 'refined_finer' else 1
            start = run_algorithm(scan, ASDPOCS(niter=LONG)).volume
            return means(refine(scan, start, Best.niter, finer).volume, finer)
        cloud = self._cloud(case)[0]
        if setting == 'cloud':
            return cloud.volume()
        if setting == 'cloud_finer':
            return run_algorithm(scan, Refined(finer=2, completed_niter=0, niter=4), sample=cloud.volume).volume
        completed = insert_views(scan, max(COMPLETED, len(scan)), cloud.render)
        if setting == 'completed':
            return run_algorithm(completed, ASDPOCS(niter=10)).volume
        return run_algorithm(scan, Refined(), sample=cloud.volume, completed=completed).volume

    def _fitted(self, case: Case) -> tuple[Fit, float]:
        began, scan = time.process_time(), self.dataset(case).train
        return fit(scan, Fast()), time.process_time() - began

    def _dataset(self, case: Case) -> Dataset:
        if case.object in MEASURED:
            return self._measured(case)
        geometry, views, truth = simulated(case.object, self.size, 5 * self.size // 3, case.views, case.finer)
        if case.photons:
            views = noisy(views, counting(case.photons))
        return Dataset(Scan(geometry, views), None, truth)

    @staticmethod
    def check(case: Case) -> None:
        """Raises InputError for a case that there is not."""
        if case.object in MEASURED and (case.finer != 1 or case.photons):
            raise InputError(
                f'{case.object} is measured: it has its own detail and noise, so give --finer 1 and --photons 0'
            )

    def _measured(self, case: Case) -> Dataset:
        every = load_scene(scene_path(case.object)).scanner.dataset
        assert every is not None  # it has no object
        train, whole = every.train, every.train.geometry
        shape = [max(1, round(n * self.size / max(whole.grid.shape))) for n in whole.grid.shape]
        train = train.binned(max(1, round(max(whole.nDetector) / (2 * self.size))))
        spacing = [side / n for side, n in zip(whole.grid.size, shape)]
        train = train.on(Grid(shape, spacing, train.geometry.grid.centre))
        return replace(choose_views(Dataset(train), case.views), volume=run_algorithm(train, FDK()).volume)

    def table(self, cases: Iterable[Case]) -> str:
        """The Markdown table of the cells that are there, a row a case: dB and processor seconds.

        The regret of `Best` counts the fixed settings without a cloud; the regret of `Best(cloud=True)` counts all. Clouds have
        columns if there are cells of them.
        """
        cases = list(cases)
        clouds = any(self.get(case, name) for case in cases for name in (*CLOUDS, BEST_CLOUD))
        names = VOXELS | (CLOUDS if clouds else {})
        heads = ['object', 'scanned', 'views', 'photons', '**best**', 'regret, dB', 'error map']
        heads += (['with a cloud', 'regret, dB'] if clouds else []) + list(names.values())
        lines = [f'| {" | ".join(heads)} |', '|---|' + '---:|' * (len(heads) - 1)]
        for case in cases:
            chosen, with_cloud = self.get(case, BEST), self.get(case, BEST_CLOUD)
            if chosen is None:
                continue
            fixed = {name: cell for name in names if (cell := self.get(case, name))}
            photons = f'{case.photons:g}' if case.photons else 'measured' if case.object in MEASURED else 'no noise'
            row = [case.object, f'x{case.finer}', str(case.views), photons]
            row += [_cell(chosen), _regret(chosen, [fixed[name] for name in VOXELS if name in fixed])]
            row += [f'{chosen["error_map"]:.2f}']
            if clouds:
                row += [_cell(with_cloud), _regret(with_cloud, fixed.values())]
            lines.append(f'| {" | ".join([*row, *(_cell(fixed.get(name)) for name in names)])} |')
        return '\n'.join(lines)


def _cell(cell: dict | None) -> str:
    return f'{cell["psnr_3d"]:.2f} ({cell["seconds"]:.0f} s)' if cell else '–'


def _regret(cell: dict | None, fixed: Iterable[dict]) -> str:
    return f'{max((other["psnr_3d"] for other in fixed), default=np.nan) - cell["psnr_3d"]:+.2f}' if cell else '–'
