"""Live progress of long loops, on standard error.

On a terminal: a bar with the time gone and left. Elsewhere (a file, a pipe, a batch system): one plain line
about every 10 % or 10 seconds, one line in all for a loop of less than a second, without control characters.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any

LABELS = {
    'psnr': 'PSNR {:.2f} dB',
    'psnr_2d': 'PSNR {:.2f} dB',
    'psnr_3d': '3D {:.2f} dB',
    'gaussians': '{:,} Gaussians',
    'held_out': 'search: held-out error {:.4g}',
    'stops_at': 'stops at step {:,}',
}
REDRAW = 0.25  # seconds between two redraws on a terminal
PAUSE = 1.0  # least seconds between two plain lines, except before the last
LINE = 10.0  # seconds between two plain lines, if 10 % takes longer


class Progress:
    """Progress through `total` steps.

    `update` may be called at every step: it returns at once unless there is something to draw.

    Examples
    --------
    >>> with Progress('Fit', 30_000) as progress:
    ...     for i in range(30_000):
    ...         ...
    ...         progress.update(i + 1, loss=lambda: float(loss), gaussians=n)
    """

    def __init__(self, description: str, total: int, start: int = 0, shown: bool = True):
        """total: steps in all; start: steps done before the loop begins (a resumed fit); shown: False draws nothing."""
        self.description, self.total, self.start = description, int(total), int(start)
        self._done = self.start
        self._fields: dict[str, Any] = {}
        self._file, self._quiet = sys.stderr, not shown
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> Progress:
        self._began = self._drawn = time.monotonic()
        self._shown = self.start  # steps at the latest drawing
        self._first = None  # when the first step was done, and its number
        if not self._quiet and self._file.isatty() and os.environ.get('TERM') != 'dumb':
            self._bar = _bar(self._file)
            self._task = self._bar.add_task(self.description, total=self.total, completed=self.start, fields='')
            self._bar.start()
        return self

    def __exit__(self, *error):
        if self._shown != self._done and not self._quiet:
            self._draw(time.monotonic())
        if self._bar:
            self._bar.stop()

    def update(self, iteration: int, **fields: Any) -> None:
        """Say that `iteration` steps are done.

        Parameters
        ----------
        fields
            Values to show beside the bar, by name: numbers (`loss`, `psnr_2d`, `gaussians`, ...), text, or functions without
            arguments that give one. A function is called only when its value is drawn, so that reading a number back from the
            device does not slow the loop. None is not shown.
        """
        self._done = iteration
        if self._quiet:
            return
        if fields:
            self._fields = fields
        now = time.monotonic()
        self._first = self._first or (now, iteration)
        if self._bar:
            due = now - self._drawn >= REDRAW
        else:
            tenth = (iteration - self._shown) * 10 >= self.total
            due = now - self._drawn >= (PAUSE if tenth else LINE)
        if due or iteration == self.total:
            self._draw(now)

    def _draw(self, now):
        shown = [text for name, value in self._fields.items() if (text := _text(name, value))]
        self._drawn, self._shown = now, self._done
        if self._bar:
            self._bar.update(self._task, completed=self._done, fields='  '.join(shown))
            return
        elapsed = now - self._began
        share = self._done / self.total if self.total else 1.0
        parts = [f'{self._done}/{self.total} ({share:.0%})', *shown, f'{clock(elapsed)} elapsed']
        if self.start < self._done < self.total:
            parts.append(f'{clock(self._left(now))} left')
        print(f'{self.description}: {", ".join(parts)}', file=self._file, flush=True)

    def _left(self, now):
        """Seconds at the pace since the first step, which compiles kernels, or goes on where earlier work has ended."""
        since, before = self._began, self.start
        if self._first is not None and self._first[1] < self._done:
            since, before = self._first
        return (now - since) * (self.total - self._done) / (self._done - before)


def _bar(file):
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    # Few redraws: the thread that makes them must not compete with the loop.
    return Progress(
        TextColumn('{task.description}'),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn('{task.fields[fields]}', style='cyan'),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn('left'),
        console=Console(file=file),
        refresh_per_second=1 / REDRAW,
        expand=True,
    )


def _text(name, value):
    value = value() if callable(value) else value
    if value is None:
        return None
    if isinstance(value, str):
        return f'{name} {value}'
    return LABELS[name].format(value) if name in LABELS else f'{name} {value:.4g}'


def clock(seconds: float) -> str:
    """A time as minutes and seconds, 1:05, with hours if there are any."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f'{hours}:{minutes:02d}:{seconds:02d}' if hours else f'{minutes}:{seconds:02d}'
