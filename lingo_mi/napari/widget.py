"""A widget that fits a scan and shows the volume as it grows."""

from __future__ import annotations

import threading
from typing import Any

from magicgui import widgets  # pyright: ignore[reportMissingImports]
from superqt.utils import ensure_main_thread, thread_worker  # pyright: ignore[reportMissingImports]

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.files.scans import read_scan
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods.by_name import METHODS, method_of
from lingo_mi.napari.reader import volume_layer


class FitWidget(widgets.Container):
    """A scan, a method and a number of steps; `Fit` starts, `Cancel` stops after the step that runs.

    Parameters
    ----------
    napari_viewer : napari.Viewer
        The viewer that gets the volume as a layer, which is updated.
    """

    def __init__(self, napari_viewer: Any):
        self._viewer, self._stop, self._layer = napari_viewer, threading.Event(), None
        self.scan = widgets.FileEdit(label='Scan', mode='r')
        self.method = widgets.ComboBox(
            label='Method', choices=[name for name, method in METHODS.items() if method.makes_volume]
        )
        self.steps = widgets.SpinBox(label='Steps', min=1, max=1_000_000, value=METHODS['fast'].iterations)
        self.start, self.cancel = widgets.PushButton(text='Fit'), widgets.PushButton(text='Cancel', enabled=False)
        self.status = widgets.Label(value='')
        super().__init__(widgets=[self.scan, self.method, self.steps, self.start, self.cancel, self.status])
        self.start.changed.connect(self.fit)
        self.cancel.changed.connect(self._stop.set)

    def fit(self) -> Any:
        """Fit in a thread of its own, which is returned."""
        self._stop.clear()
        self._layer = None
        self.start.enabled, self.cancel.enabled = False, True
        worker = thread_worker(self._run)(str(self.scan.value), self.method.value, self.steps.value)
        worker.errored.connect(lambda error: self._end(str(error)))
        worker.returned.connect(self._end)
        worker.start()
        return worker

    def _run(self, path: str, name: str, steps: int) -> str:
        try:
            ensure_variant()  # of this thread
            method, scan = method_of(name, iterations=steps), read_scan(path).train

            def show(fit: Fit) -> dict:
                self._show(fit.scan_volume, scan.geometry.grid, fit.steps, steps)
                return {}

            def between(iteration: int, **_: Any) -> None:
                if self._stop.is_set():
                    raise KeyboardInterrupt

            run(scan, method, measure=show, progress=between)
        except KeyboardInterrupt:
            return 'cancelled'
        except InputError as error:
            return str(error)
        return 'done'

    @ensure_main_thread
    def _show(self, volume: Any, grid: Any, done: int, steps: int) -> None:
        first = grid.low + [s / 2 for s in grid.spacing]
        data, options, _ = volume_layer(volume, grid.spacing, first, f'fit of {self.scan.value.name}')
        if self._layer is None:
            self._layer = self._viewer.add_image(data, **options)
        else:
            self._layer.data = data
        self.status.value = f'step {done:,} of {steps:,}'

    def _end(self, status: str) -> None:
        self.start.enabled, self.cancel.enabled = True, False
        self.status.value = status
