"""The provenance of a table: the command, the commit, the date, the machine and the versions, as JSON beside it."""

from __future__ import annotations

import datetime
import json
import platform
import shlex
import subprocess
import sys
from importlib import resources
from pathlib import Path

from lingo_mi.fitting.save import versions
from lingo_mi.storage.file_access import replacing

ROOT = Path(str(resources.files('lingo_mi'))).resolve().parent  # of the checkout, or site-packages


def command() -> str:
    """This process's command line."""
    return ' '.join([sys.argv[0], *map(shlex.quote, sys.argv[1:])])


def provenance(of: str | None = None) -> dict:
    """Return the provenance of the numbers that are measured now.

    - `command`: the command line
    - `commit`: the commit of the checkout that `lingo_mi` runs from, with '+' if its files have changed; None if it is
      installed
    - `date`: now, UTC, ISO 8601
    - `machine`: the processor's name
    - `versions`: of Python and of the packages that numbers depend on

    Parameters
    ----------
    of : str or None
        The command line, if it is another process's.
    """
    return dict(
        command=of or command(),
        commit=commit(),
        date=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec='seconds'),
        machine=machine(),
        versions={name: number for name, number in versions().items() if name != 'date'},
    )


def write_provenance(table: Path) -> Path:
    """Write `provenance` beside a table, as NAME.provenance.json for NAME.md; returns where."""
    path = Path(table).with_suffix('.provenance.json')
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(provenance(), indent=1) + '\n', encoding='utf-8')
    return path


def commit() -> str | None:
    """The commit of the checkout that `lingo_mi` runs from, and '+' if its files have changed since; None if it runs from no
    checkout of its own."""
    if not (ROOT / 'pyproject.toml').is_file():  # site-packages may lie in the checkout of another project
        return None
    try:
        done = subprocess.run(['git', 'rev-parse', 'HEAD'], cwd=ROOT, capture_output=True, text=True)
        changed = subprocess.run(['git', 'status', '--porcelain', '-uno'], cwd=ROOT, capture_output=True, text=True)
    except OSError:  # there is no git
        return None
    return done.stdout.strip() + '+' * bool(changed.stdout.strip()) if done.returncode == 0 else None


def machine() -> str:
    """The processor's name, as far as the system tells."""
    try:
        with open('/proc/cpuinfo', encoding='utf-8') as lines:
            return next(line.split(':')[1].strip() for line in lines if line.startswith('model name'))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
