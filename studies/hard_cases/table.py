"""The Markdown page of the hard cases."""

from __future__ import annotations

from collections.abc import Iterable

from lingo_mi.studies.hard_cases.measuring import PARAMETERS

INTRODUCTION = """# Hard cases

Written by `lingo-mi hard-cases --markdown FILE`; asserted by `tests/studies/test_hard_cases.py`. Errors in float32
against float64 on the same input, relative. Of the image: its root mean square deviation over its root mean square. Of
derivatives, for each Gaussian and each kind of parameter: the norm of the deviation over the norm of all derivatives of that
Gaussian, after all are converted to one unit (`lingo_mi.studies.hard_cases.measuring` says how); the worst Gaussian's is shown.
*At most* is what the tests allow.
"""


def markdown(results: Iterable[tuple]) -> str:
    """The page. results   pairs of a case and what `measure` found"""
    lines = [
        INTRODUCTION,
        '| case | image | at most | ' + ' | '.join(PARAMETERS) + ' | at most | remark |',
        '|---' * 9 + '|',
    ]
    for case, result in results:
        limits = [None] * 2 if result.image is None else [case.image, case.gradient]
        numbers = [result.image, limits[0], *(result.gradients.get(name) for name in PARAMETERS), limits[1]]
        remark = '; '.join(
            filter(
                None,
                (
                    result.refused and f'refused: {result.refused}',
                    result.warned and f'warned: {result.warned}',
                    case.note,
                ),
            )
        )
        cells = [case.name, *('' if x is None else f'{x:.0e}' for x in numbers), remark]
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'
