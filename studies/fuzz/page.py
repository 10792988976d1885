"""The page of the documentation: what the readers made of mutated files."""

from __future__ import annotations

import datetime

from lingo_mi.validation.markdown import table
from studies.fuzz.pool import Tally


def page(tallies: dict[str, Tally], seed: int, wall: float, seconds: float, memory: int) -> str:
    """The Markdown text.

    Parameters
    ----------
    wall : float
        Seconds that all cases took.
    seconds : float
        Seconds that a case may take.
    memory : int
        Bytes that a child may take.
    """
    total = sum(tally.cases for tally in tallies.values())
    failed = sum(len(tally.failures) for tally in tallies.values())
    date = datetime.datetime.now(datetime.timezone.utc).date()
    rows = table(
        [
            ('reader', lambda row: row[0]),
            ('cases', lambda row: f'{row[1].cases}'),
            ('read', lambda row: f'{row[1].values}'),
            ('refused', lambda row: f'{row[1].refused}'),
            ('failed', lambda row: f'{len(row[1].failures)}'),
            ('cases a second', lambda row: f'{row[1].cases / max(row[1].seconds, 1e-9):.0f}'),
        ],
        tallies.items(),  # type: ignore[arg-type] - rows of any kind do
    )
    return f"""# Mutated files

Written by `python -m studies.fuzz --markdown FILE` with the seed {seed} on {date}: {total} files, each a good one with some
mutations, in {wall:.0f} s. A case fails where its reader crashes, takes more than {seconds:g} s or {memory / 2**30:g} GiB,
raises anything but an `InputError` of one printable line, or returns numbers that are not finite. {failed} failed. *Read*: the
mutation left a file that makes sense.

{rows}
"""
