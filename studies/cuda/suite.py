"""The tests on cuda_ad_mono, under a stand-in for the CUDA driver."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

# Of every part that computes on the device, what takes few minutes.
SHARE = (
    'projectors/test_balance.py',
    'projectors/test_splat.py',
    'projectors/test_mesh.py',
    'projectors/test_voxelize.py',
    'projectors/test_joseph.py',
    'plugins/test_integrator.py',
    'reconstruction/test_iterative.py',
    'fitting/test_fit.py',
    'fitting/test_losses.py',
    'functional/test_functional.py',
    'studies/test_gradient_check.py',
    'test_memory.py',
)
WORKERS = 2  # test files at a time: the stand-in runs one thread


@dataclass
class Outcome:
    """What the tests came to.

    passed    how many
    failed    names, with files that did not end
    skipped   how many, by reason
    """

    passed: int = 0
    failed: list[str] = field(default_factory=list)
    skipped: Counter = field(default_factory=Counter)

    def add(self, other: Outcome) -> None:
        self.passed += other.passed
        self.failed += other.failed
        self.skipped += other.skipped


def all_files(tests: Path) -> list[Path]:
    """All test files of a checkout."""
    return sorted(Path(tests).rglob('test_*.py'))


def run_tests(stand_in: Path, files: Iterable[Path], report: Callable[[str], None], **settings: str | int) -> Outcome:
    """Run test files, a process each.

    stand_in   the program that runs a command with its driver
    files      within a checkout; the tests run from its root
    report     called with a line for every file
    settings   the stand-in's variables, without their prefix: SM=80, DUMP='folder', NOISE=1
    """
    variables = {f'CUDA_ON_CPU_{name}': str(value) for name, value in settings.items()}
    variables |= dict(LINGO_MI_TEST_VARIANT='cuda_ad_mono', LINGO_MI_CUDA_STAND_IN=str(stand_in))
    total = Outcome()

    def run(file):
        with tempfile.TemporaryDirectory() as folder:
            result = Path(folder) / 'result.xml'
            command = [stand_in, sys.executable, '-m', 'pytest', '-q', file, f'--junitxml={result}']
            root = next(p.parent for p in Path(file).resolve().parents if p.name == 'tests')
            done = subprocess.run(command, cwd=root, env=os.environ | variables, capture_output=True, text=True)
            found = _read(result) if result.exists() else Outcome(failed=[f'{Path(file).name}: ended by itself'])
        if done.returncode not in (0, 5) and not found.failed:  # 5: there are no tests
            found.failed.append(f'{Path(file).name}: exit code {done.returncode}')
        return file, found

    with ThreadPoolExecutor(WORKERS) as pool:
        for file, found in pool.map(run, files):
            total.add(found)
            report(
                f'{Path(file).name}: {found.passed} passed, {found.skipped.total()} skipped, {len(found.failed)} failed'
            )
    return total


def _read(result: Path) -> Outcome:
    """The outcome that pytest's JUnit file holds."""
    out = Outcome()
    for case in ET.parse(result).iter('testcase'):
        skipped = case.find('skipped')
        if case.find('failure') is not None or case.find('error') is not None:
            out.failed.append(f'{case.get("classname")}: {case.get("name")}')
        elif skipped is not None:
            out.skipped[skipped.get('message', '')] += 1
        else:
            out.passed += 1
    return out
