"""A fit as TensorBoard's events: numbers, slices, views (needs the extra `tensorboard`)."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.notebook import grey_range
from lingo_mi.fitting.fit import Fit
from lingo_mi.report.planes import plane, richest
from lingo_mi.storage.file_access import as_path, optional, writing


class EventLog:
    """A watcher (see `watch.Watcher`) that writes events into a folder, for `tensorboard --logdir FOLDER`.

    Raises
    ------
    InputError
        If tensorboardX is missing, or the folder cannot be written.
    """

    def __init__(self, folder: PathLike | str):
        """folder: is created if missing; a run's events are a file there, beside the files of earlier runs."""
        library = optional('tensorboardX', 'tensorboard')
        path: Path = as_path('log_dir', folder)
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
            if not path.is_dir():
                raise InputError(f'{path}: is a file; give a folder')
            self._writer: Any = library.SummaryWriter(str(path), flush_secs=5)
        self._pictures: list[tuple[str, np.ndarray]] = []  # of the step that `step` tells of next

    def search(self, iteration: int, held_out: float) -> None:
        """See `watch.Watcher`. Its steps are not steps of the fit: nothing is written."""

    def step(self, entry: dict, total: int) -> None:
        """See `watch.Watcher`."""
        for name, value in entry.items():
            if name not in ('iteration', 'seconds') and value is not None:
                self._writer.add_scalar(name, value, entry['iteration'])
        for name, image in self._pictures:
            self._writer.add_image(name, image, entry['iteration'], dataformats='HW')
        self._pictures = []

    def snapshot(self, fit: Fit) -> None:
        """See `watch.Watcher`. Slices are the reconstruction, and beside it the truth if there is one."""
        data = fit.data
        if fit.method.makes_volume:
            truth = None if data is None else data.volume
            shown = [fit.scan_volume] if truth is None else [fit.scan_volume, truth]
            window = grey_range(shown[-1])
            for axis, name in ((2, 'axial'), (1, 'coronal'), (0, 'sagittal')):
                index = richest(shown[-1], axis)
                self._picture(f'slices/{name}', [plane(v, axis, index)[::-1] for v in shown], window)
        if data is not None and data.test is not None and fit.views is not None:
            pair = [fit.views[0], data.test.projections[0]]
            self._picture('views/rendered_measured', pair, grey_range(pair[1]))

    def close(self, finished: bool) -> None:
        """See `watch.Watcher`."""
        self._writer.close()

    def _picture(self, name: str, images: list[np.ndarray], window: tuple[float, float]) -> None:
        row = (np.concatenate(images, 1) - window[0]) / (window[1] - window[0])
        self._pictures.append((name, (np.clip(row, 0, 1) * 255).astype(np.uint8)))
