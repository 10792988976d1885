"""The Markdown page of the hard cases, and their results in a file, so that a page can show the results of two variants."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import reading, replacing
from studies.hard_cases.measuring import PARAMETERS, Result, miss

INTRODUCTION = """# Hard cases

Written by `python -m studies.hard_cases --markdown FILE`; asserted by `tests/studies/test_hard_cases.py`. Errors in float32
against float64 on the same input, relative. Of the image: its root mean square deviation over its root mean square. Of
derivatives, for each Gaussian and each kind of parameter: the norm of the deviation over the norm of all derivatives of that
Gaussian, after all are converted to one unit (`studies.hard_cases.measuring` says how); the worst Gaussian's is shown.
*At most* is what the tests allow.
"""


@dataclass(frozen=True)
class Stored:
    """The results of an earlier run.

    Parameters
    ----------
    variant : str
        Mitsuba's, that they were measured with.
    results : dict[str, Result]
        Results by the case's name.
    notes : dict[str, str]
        Notes on the cases, by name.
    """

    variant: str
    results: dict[str, Result]
    notes: dict[str, str]

    @property
    def title(self) -> str:
        """The variant's backend, such as CUDA."""
        return self.variant.split('_')[0].upper()

    def misses(self, cases: Sequence) -> dict[str, str]:
        """Return the faults of cases in words, by name. A case that was not measured has no faults."""
        misses = {
            case.name: miss(case, self.results[case.name], self.variant) for case in cases if case.name in self.results
        }
        return {name: wrong for name, wrong in misses.items() if wrong}


def store(path: Path, variant: str, results: Sequence[tuple]) -> None:
    """Write results into a file that `stored` reads. results   pairs of a case and what `measure` found"""
    cases = [dict(name=case.name, variant=variant, note=case.note, **asdict(result)) for case, result in results]
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(cases, indent=1) + '\n', encoding='utf-8')


def stored(path: Path) -> Stored:
    """Read the results that `store` wrote.

    Raises
    ------
    InputError
        If the file cannot be read or holds something else.
    """
    with reading(path):
        text = Path(path).read_text(encoding='utf-8')
    try:
        cases = json.loads(text)
        (variant,) = {case.pop('variant') for case in cases}
        notes = {case['name']: case.pop('note') for case in cases}
        results = {case.pop('name'): Result(**case) for case in cases}
    except (ValueError, TypeError, KeyError, AttributeError):
        raise InputError(
            f'{path}: is not a file of hard cases; write one with python -m studies.hard_cases --json'
        ) from None
    return Stored(variant, results, notes)


def markdown(results: Sequence[tuple], beside: Stored | None = None) -> str:
    """The page.

    Parameters
    ----------
    results : Sequence[tuple]
        Pairs of a case and what `measure` found.
    beside : Stored or None
        Another variant's results, to be shown in columns of their own: the image and the worst derivative. What else is different
        there is a remark: a miss, a shorter fit, a case that was not measured.
    """
    titles = ['case', 'image', 'at most', *PARAMETERS, 'at most', 'remark']
    if beside:
        titles[2:2] = [f'image, {beside.title}']
        titles[-2:-2] = [f'derivatives, {beside.title}']
    lines = [INTRODUCTION, f'| {" | ".join(titles)} |', '|---' * len(titles) + '|']
    if beside:
        lines[1:1] = [
            f'Columns of {beside.title} belong to `{beside.variant}`; of derivatives, they show the worst kind.\n'
        ]
    misses = beside.misses([case for case, _ in results]) if beside else {}
    for case, result in results:
        limits = [None] * 2 if result.image is None else [case.image, case.gradient]
        numbers = [result.image, limits[0], *(result.gradients.get(name) for name in PARAMETERS), limits[1]]
        remarks = [
            result.refused and f'refused: {result.refused}',
            result.warned and f'warned: {result.warned}',
            case.note,
        ]
        if beside:
            other = beside.results.get(case.name)
            numbers[1:1] = [other and other.image]
            numbers[-1:-1] = [max(other.gradients.values(), default=None) if other else None]
            note = beside.notes.get(case.name, 'not measured')
            remarks += [f'{beside.title}: {x}' for x in (note != case.note and note, misses.get(case.name)) if x]
        cells = ['' if x is None else f'{x:.0e}' for x in numbers]
        lines.append(f'| {" | ".join([case.name, *cells, "; ".join(filter(None, remarks))])} |')
    return '\n'.join(lines) + '\n'
