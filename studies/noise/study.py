"""Gain of an early stop and of pixel weights in a fit of noisy projections.

A cell is one fit of one scan by `Fast`: a JSON file, written atomically. A stored cell is not computed again.

    study = Study(Path('out/noise'))
    study.compute_missing([Case('foot', photons=1000)])
    print(study.table([Case('foot', photons=1000)]))
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.metrics.quality import psnr_3d
from lingo_mi.scan import Scan
from lingo_mi.validation.provenance import provenance
from lingo_mi.validation.tables.photons import counting, noisy
from studies.cell_files import CellFiles
from studies.simulated import simulated

EVERY = 50  # steps between two looks at the volume
SETTINGS: dict[str, dict[str, Any]] = {
    'equal': dict(stop='off'),
    'stopped': dict(stop='on'),
    'noise': dict(stop='off', weights='noise'),
}

WEIGHTED = 'noise'


@dataclass(frozen=True)
class Case:
    """A scan.

    Parameters
    ----------
    object : str
        One of `lingo_mi.validation.tables.objects`, scanned over a full turn.
    photons : float
        A pixel in the open beam.
    finer : int
        How many times as many voxels are scanned along each side.
    views : int
        Fitted.
    """

    object: str
    photons: float
    finer: int = 2
    views: int = 25


class Study:
    """The cells of one size below a folder: volumes of `size` voxels along the longest side, panels of `pixels` a side.

    Parameters
    ----------
    iterations : int
        Steps of a fit, at most.
    """

    def __init__(self, folder: Path, size: int = 64, pixels: int = 64, iterations: int = Fast.iterations):
        self.size, self.pixels, self.iterations = size, pixels, iterations
        self.cells = CellFiles(folder, 'steps', 'psnr_3d')
        self.dataset = functools.lru_cache(1)(self._dataset)

    def name(self, case: Case) -> str:
        scan = f'{case.object}_{self.size}_{self.pixels}_x{case.finer}_{case.views}_views_{case.photons:.17g}_photons'
        steps = '' if self.iterations == Fast.iterations else f'_{self.iterations}_steps'
        return f'{scan}{steps}'

    def get(self, case: Case, setting: str) -> dict | None:
        """A stored cell, or None if there is none that can be read."""
        return self.cells.get(self.name(case), setting)

    def compute_missing(
        self, cases: Iterable[Case], settings: Iterable[str], say: Callable[[str], object] = lambda line: None
    ) -> None:
        """Compute and store the cells that are missing. settings: names of SETTINGS."""
        for case in cases:
            for setting in settings:
                if self.get(case, setting) is None:
                    cell = self._compute(case, setting)
                    last, best = cell['psnr_3d'][-1], max(cell['psnr_3d'])
                    self.cells.put(self.name(case), setting, cell)
                    say(f'{case}, {setting}: {last:.2f} dB after {cell["steps"][-1]} steps, at best {best:.2f}')

    def _compute(self, case: Case, setting: str) -> dict:
        scan, truth = self.dataset(case)
        method = Fast().changed(iterations=self.iterations, **SETTINGS[setting])

        def measure(fit):
            return dict(psnr_3d=psnr_3d(fit.volume(), truth))

        began = time.process_time()
        fitted = run(scan, method, measure=measure, at=range(EVERY, self.iterations + 1, EVERY))
        return dict(
            asdict(case),
            setting=setting,
            steps=[entry['iteration'] for entry in fitted.history],
            psnr_3d=[entry['psnr_3d'] for entry in fitted.history],
            search=fitted.search,
            seconds=time.process_time() - began,
            size=self.size,
            pixels=self.pixels,
            provenance=provenance(),
        )

    def _dataset(self, case: Case) -> tuple[Scan, np.ndarray]:
        geometry, views, truth = simulated(case.object, self.size, self.pixels, case.views, case.finer)
        detector = counting(case.photons)
        return Scan(geometry, noisy(views, detector), effects=Effects(detector=detector)), truth

    def table(self, cases: Iterable[Case]) -> str:
        """The Markdown table of the cells that are there, a row a case: dB of the volume (after so many steps)."""
        cells = {case: {name: cell for name in SETTINGS if (cell := self.get(case, name))} for case in cases}
        weighed = any(WEIGHTED in numbers for numbers in cells.values())
        heads = ['all steps', 'best of all steps', '**stopped**', 'behind the best']
        heads += ['weights 1 / s, all steps', 'weights 1 / s, best'] * weighed
        lines = [f'| object | scanned | photons | {" | ".join(heads)} |', '|---|---:|---:|' + '---:|' * len(heads)]
        for case, numbers in cells.items():
            if not numbers:
                continue
            equal = numbers.get('equal')
            row = [_shown(*of(equal)) if equal else '–' for of in (_last, _best)]
            row += _stopped(numbers.get('stopped'), _best(equal)[0] if equal else None)
            if weighed:
                row += [_shown(*of(numbers[WEIGHTED])) if WEIGHTED in numbers else '–' for of in (_last, _best)]
            lines.append(f'| {case.object} | x{case.finer} | {case.photons:g} | {" | ".join(row)} |')
        return '\n'.join(lines)


def _stopped(cell: dict | None, top: float | None) -> list[str]:
    if cell is None:
        return ['–', '–']
    return [_shown(*_last(cell)), '–' if top is None else f'{top - _last(cell)[0]:+.2f}']


def _last(cell: dict) -> tuple[float, int]:
    return cell['psnr_3d'][-1], cell['steps'][-1]


def _best(cell: dict) -> tuple[float, int]:
    return max(zip(cell['psnr_3d'], cell['steps']))


def _shown(dB: float, steps: int) -> str:
    return f'{dB:.2f} ({steps})'
