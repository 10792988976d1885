"""The Markdown page of what `python -m studies.cuda_check` found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from lingo_mi.validation.markdown import table
from studies.cuda.assemble import Kernel
from studies.cuda.suite import Outcome

INTRODUCTION = """# CUDA without a GPU

Written by `python -m studies.cuda_check --stand-in PROGRAM --markdown FILE`. The tests ran on `cuda_ad_mono` under a stand-in for
the CUDA driver, which runs Dr.Jit's PTX on the CPU; it traces no rays and finds no races. Every kernel that they compiled
went through `ptxas`, NVIDIA's assembler. Files of tests that load no kernel ran once for all devices. *Noise*: approximate
instructions err by as much as NVIDIA allows. *Checked*: every address is."""
LARGEST = 8  # kernels listed


def page(outcomes: dict[str, Outcome], kernels: Sequence[Kernel]) -> str:
    """The page. outcomes   of the tests, by what they ran on"""
    tests = table(
        [
            ('tests on', lambda row: row[0]),
            ('passed', lambda row: f'{row[1].passed}'),
            ('skipped', lambda row: f'{row[1].skipped.total()}'),
            ('failed', lambda row: f'{len(row[1].failed)}'),
        ],
        outcomes.items(),  # type: ignore[arg-type] - rows of any kind do
    )
    reasons: dict[str, int] = {}
    for outcome in outcomes.values():
        for reason, count in outcome.skipped.items():
            reasons[reason] = max(count, reasons.get(reason, 0))
    skipped = table([('skipped because', lambda row: row[0]), ('tests', lambda row: f'{row[1]}')], reasons.items())  # type: ignore[arg-type]
    failed = [f'- {title}: {name}' for title, outcome in outcomes.items() for name in outcome.failed]
    parts = [INTRODUCTION, '## Tests', tests, skipped, *(['\n'.join(['Failed:', '', *failed])] if failed else [])]
    return '\n\n'.join([*parts, '## Kernels', *_kernels(kernels)]) + '\n'


def _kernels(kernels):
    kinds = {True: '', False: ", Dr.Jit's own matrix products"}
    groups = {
        f'sm_{sm}{kind}': [k for k in kernels if k.sm == sm and k.ours == ours]
        for sm in sorted({k.sm for k in kernels})
        for ours, kind in kinds.items()
    }
    summary = table(
        [
            ('assembled for', lambda row: row[0]),
            ('kernels', lambda row: f'{len(row[1])}'),
            ('registers, median', lambda row: f'{sorted(k.registers for k in row[1])[len(row[1]) // 2]}'),
            ('most', lambda row: f'{max(k.registers for k in row[1])}'),
            ('above 128', lambda row: f'{sum(k.registers > 128 for k in row[1])}'),
            ('spill', lambda row: f'{sum(k.spilled > 0 for k in row[1])}'),
            ('not assembled', lambda row: f'{sum(k.error is not None for k in row[1])}'),
        ],
        [row for row in groups.items() if row[1]],  # type: ignore[arg-type]
    )
    largest = sorted((k for k in kernels if k.ours), key=lambda k: (-k.spilled, -k.registers))[:LARGEST]
    rows = table(
        [
            ('kernel', lambda k: f'`{k["name"][6:18]}`'),
            ('compiled by', lambda k: f'`{k["test"]}`'),
            ('for', lambda k: f'sm_{k["sm"]}'),
            ('PTX instructions', lambda k: f'{k["lines"]}'),
            ('registers', lambda k: f'{k["registers"]}'),
            ('bytes spilled', lambda k: f'{k["spilled"]}'),
        ],
        map(asdict, largest),
    )
    errors = [f'- `{k.name}`, sm_{k.sm}: {k.error}' for k in kernels if k.error]
    return [
        summary,
        'Those that spill, then those with the most registers:',
        rows,
        *(['\n'.join(errors)] if errors else []),
    ]
