"""The watchers that a fit is asked for."""

from __future__ import annotations

from os import PathLike

from lingo_mi.common.errors import require_type
from lingo_mi.geometry.base import Geometry
from lingo_mi.results.event_log import EventLog
from lingo_mi.results.live import Live
from lingo_mi.results.watch import Watcher


def watchers_of(geometry: Geometry, live: bool, log_dir: str | PathLike | None, title: str) -> list[Watcher]:
    """A live page, whose address is printed, and a log of events, each if it is asked for.

    Raises
    ------
    InputError
        If the log cannot be written, or its library is missing.
    """
    require_type('live', live, bool)
    watchers: list[Watcher] = [] if log_dir is None else [EventLog(log_dir)]
    if live:
        page = Live(geometry, title)
        page.announce()
        watchers.append(page)
    return watchers
