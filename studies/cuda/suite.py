"""The tests on cuda_ad_mono, under a stand-in for the CUDA driver."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

from studies.cell_files import CellFiles
from studies.cuda.assemble import Kernel, assemble

# Tests of every part that computes on the device, which take few minutes.
SHARE = (
    'projectors/test_balance.py',
    'projectors/test_splat.py',
    'projectors/test_mesh.py',
    'projectors/test_voxelize.py',
    'projectors/test_joseph.py',
    'projectors/test_tilted_joseph.py',
    'plugins/test_integrator.py',
    'plugins/test_sensors.py',
    'reconstruction/test_iterative.py',
    'fitting/test_fit.py',
    'fitting/test_loop.py',
    'fitting/test_losses.py',
    'functional/test_functional.py',
    'functional/test_projector.py',
    'validation/test_gradient_check.py',
    'common/test_memory.py',
)
WORKERS = 2  # test files at a time: the stand-in runs one thread
CODE = ('lingo_mi', 'studies', 'plugins', 'scenes', 'scripts', 'examples', 'tests', 'pyproject.toml')
ANY = 'any'  # the case of cells that hold on every device


@dataclass
class Outcome:
    """Outcome of the tests.

    Parameters
    ----------
    passed : int
        How many.
    failed : list[str]
        Names, with files that did not end.
    skipped : Counter
        How many, by reason.
    """

    passed: int = 0
    failed: list[str] = field(default_factory=list)
    skipped: Counter = field(default_factory=Counter)

    def __post_init__(self):
        self.skipped = Counter(self.skipped)  # a stored cell has a plain dictionary

    def add(self, other: Outcome) -> None:
        self.passed += other.passed
        self.failed += other.failed
        self.skipped += other.skipped


def all_files(tests: Path) -> list[str]:
    """The names of all test files in a folder and those below it."""
    return sorted(p.relative_to(tests).as_posix() for p in Path(tests).rglob('test_*.py'))


def run_tests(
    stand_in: Path,
    tests: Path,
    names: Iterable[str],
    *,
    sm: int,
    noise: bool = False,
    cells: CellFiles,
    report: Callable[[str], None],
) -> tuple[Outcome, list[Kernel]]:
    """Run test files, a process each, and assemble the kernels that they compile.

    A file whose tests load no kernel runs once for all devices.

    Parameters
    ----------
    stand_in : Path
        The program that runs a command with its driver.
    tests : Path
        The folder of tests of a checkout.
    names : Iterable[str]
        Names of files in it; they run from the checkout's root.
    sm : int
        Compute capability times ten.
    noise : bool
        Approximate instructions err by as much as NVIDIA allows, and every address is checked.
    cells : CellFiles
        Finished test files, a cell each; a file is run again only if it failed or belongs to other code.
    report : callable
        Called with a line for every file.
    """
    run, compiled_kernels, now = f'sm_{sm}_noise' if noise else f'sm_{sm}', set(), _code(tests)
    total, kernels = Outcome(), {}

    def cell(name):
        start = time.perf_counter()
        for case in run, ANY:
            stored = cells.get(case, name)
            if stored is not None and stored['code'] == now and not stored['outcome']['failed']:
                outcome, compiled = Outcome(**stored['outcome']), [Kernel(**kernel) for kernel in stored['kernels']]
                break
        else:
            outcome, compiled, loads = _run_file(stand_in, tests, name, sm, noise, compiled_kernels)
            record = dict(outcome=vars(outcome), kernels=[asdict(kernel) for kernel in compiled], code=now)
            cells.put(run if loads else ANY, name, record)
        compiled_kernels.update(kernel.name for kernel in compiled)  # spares the next files their assembling
        return name, outcome, compiled, time.perf_counter() - start

    with ThreadPoolExecutor(WORKERS) as pool:
        for name, outcome, compiled, seconds in pool.map(cell, names):
            total.add(outcome)
            kernels = {kernel.name: kernel for kernel in compiled} | kernels
            counts = f'{outcome.passed} passed, {outcome.skipped.total()} skipped, {len(outcome.failed)} failed'
            report(f'{run}: {name}: {counts}; kernels: {len(compiled)}; {seconds:.0f} s')
    return total, list(kernels.values())


def _code(tests):
    """A digest of what the tests run: of all files of the checkout but documents."""
    root, digest = tests.resolve().parent, hashlib.sha256()
    for file in sorted(f for name in CODE for f in [root / name, *(root / name).rglob('*')] if f.is_file()):
        if '__pycache__' not in file.parts:
            digest.update(f'{file.relative_to(root)}'.encode() + b'\0' + file.read_bytes())
    return digest.hexdigest()


def _run_file(stand_in, tests, name, sm, noise, compiled_kernels):
    """The outcome of a test file, its kernels beyond those known, and whether it loads any."""
    with tempfile.TemporaryDirectory() as folder:
        result, dump = Path(folder) / 'result.xml', Path(folder) / 'ptx'
        dump.mkdir()
        variables = dict(CUDA_ON_CPU_SM=f'{sm}', CUDA_ON_CPU_DUMP=f'{dump}')
        if noise:
            variables |= dict(CUDA_ON_CPU_NOISE='1', CUDA_ON_CPU_CHECK='1')
        variables |= dict(LINGO_MI_TEST_VARIANT='cuda_ad_mono', LINGO_MI_CUDA_STAND_IN=f'{stand_in}')
        command = [
            stand_in,
            sys.executable,
            '-m',
            'pytest',
            '-q',
            '--all',
            tests.resolve() / name,
            f'--junitxml={result}',
        ]
        environment, root = os.environ | variables, tests.resolve().parent
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
        outcome = _read(result) if result.exists() else Outcome(failed=[f'{name}: ended by itself'])
        if done.returncode not in (0, 5) and not outcome.failed:  # 5: there are no tests
            outcome.failed.append(f'{name}: exit code {done.returncode}')
        modules = sorted(dump.glob('*.ptx'))
        kernels = [
            kernel for module in modules if module.stem not in compiled_kernels for kernel in assemble(module, sm, name)
        ]
        return outcome, kernels, bool(modules)


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
