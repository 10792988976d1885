#!/usr/bin/env python3
"""Does a test notice? Changes one operator or constant at a time and runs the tests that execute it.

    python tests/mutants.py --count 300 --seed 0 --report mutants.md

A mutant is the package with one expression changed: `+` for `-`, `<` for `<=`, `and` for `or`, a number doubled, a flag
turned round, a text with a letter more. Texts of messages, annotations and docstrings are left alone. The test files that
execute the changed line run on it until one fails, those first that name its module. A mutant that none notices has
survived: it needs a test, or a reason in tests/mutants_accepted.json.

Two copies of the checkout work side by side. Which test executes which line is measured first, in one run of all tests
(`--lines FILE` keeps it). With `--outcomes FILE` a stopped run goes on where it was, and after new tests only the survivors
are tried again. Exit code 1 where fewer than 90 % are noticed.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

ROOT = Path(__file__).parents[1]
PLACES = ('geometry', 'files', 'projectors', 'lingo', 'reconstruction', 'fitting', 'metrics.py')  # of lingo_mi
NEEDED = 0.9  # share of the mutants that the tests must notice
ENOUGH = 150  # seconds of tests that one mutant gets
LEFT_OUT = '.git', 'out', 'build', '__pycache__', '*.egg-info', '.pytest_cache', '.ruff_cache'
ACCEPTED = ROOT / 'tests' / 'mutants_accepted.json'

BINARY = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div, ast.Mod: ast.Mult,
          ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.MatMult: ast.Mult}  # fmt: skip
COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
            ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In}  # fmt: skip
MESSAGES = 'InputError', 'TypeError', 'ValueError', 'warn', 'optional'
CHECKS = '_require', 'fail', 'require_type'  # their texts are messages, too


@dataclass(frozen=True)
class Mutant:
    """One change: `text` takes the place of what stands from `begin` to `end` in a file.

    file         relative to the checkout
    line         its first line, from 1
    column       of its first character there, from 0
    around       the text of that line
    begin, end   offsets in the file's characters
    """

    file: str
    line: int
    column: int
    around: str
    begin: int
    end: int
    before: str
    text: str

    @property
    def change(self) -> str:
        return f'{" ".join(self.before.split())}  ->  {self.text}'

    @property
    def key(self) -> str:
        """The same where lines were added or removed above it."""
        return f'{self.file}  {self.around}  {self.column}  {self.change}'


def mutants(path: Path) -> Iterator[Mutant]:
    """Every change of a file."""
    source = path.read_text(encoding='utf-8')
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def offset(line, column):  # the parser counts bytes
        text = source[starts[line - 1] : starts[line]]
        return starts[line - 1] + len(text.encode()[:column].decode())

    for node, change in _changes(ast.parse(source)):
        begin, end = offset(node.lineno, node.col_offset), offset(node.end_lineno, node.end_col_offset)
        around = source[starts[node.lineno - 1] : starts[node.lineno]].strip()
        file, column = str(path.relative_to(ROOT)), begin - starts[node.lineno - 1]
        yield Mutant(file, node.lineno, column, around, begin, end, source[begin:end], change)


def _changes(tree: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, str]]:
    """Nodes of a module with the text to put in their place."""
    for node in _visited(tree):
        if isinstance(node, ast.BinOp) and type(node.op) in BINARY:
            yield node, f'({ast.unparse(ast.BinOp(node.left, BINARY[type(node.op)](), node.right))})'
        elif isinstance(node, ast.AugAssign) and type(node.op) in BINARY:
            yield node, ast.unparse(ast.AugAssign(node.target, BINARY[type(node.op)](), node.value))
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield node, f'({ast.unparse(ast.Compare(node.left, [COMPARED[type(node.ops[0])]()], node.comparators))})'
        elif isinstance(node, ast.BoolOp):
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield node, f'({ast.unparse(ast.BoolOp(other, node.values))})'
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub, ast.Invert)):
            yield node, f'({ast.unparse(node.operand)})'
        elif isinstance(node, ast.Constant):
            value = node.value
            if isinstance(value, bool):
                yield node, str(not value)
            elif isinstance(value, (int, float)):
                yield node, repr(value + 1 if isinstance(value, int) else 2 * value or 1.0)
            elif isinstance(value, str):
                yield node, repr(value + 'X')


def _visited(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those of docstrings, annotations, messages, imports, names for display and f-strings."""
    if isinstance(node, (ast.Import, ast.ImportFrom, ast.JoinedStr, ast.Raise)):
        return
    if isinstance(node, ast.FunctionDef) and node.name in ('__repr__', '__str__'):
        return
    if isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.dump(node.test):
        return
    if isinstance(node, ast.Call) and ast.unparse(node.func).split('.')[-1] in MESSAGES:
        return
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    if isinstance(node, ast.Call) and ast.unparse(node.func).split('.')[-1] in CHECKS:
        for each in node.args:
            if not (isinstance(each, ast.Constant) and isinstance(each.value, str)):
                yield from _visited(each)
        return
    yield node
    for name, child in ast.iter_fields(node):
        if name in (
            'annotation',
            'returns',
            'decorator_list',
            'bases',
            'keywords' if isinstance(node, ast.ClassDef) else '',
        ):
            continue
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) in ('__all__', '__repr__'):
            continue
        for each in child if isinstance(child, list) else [child]:
            if isinstance(each, ast.AST):
                yield from _visited(each)


# ---- running tests -----------------------------------------------------------------------------------------------------


@dataclass
class Checkout:
    """A copy of the checkout, to change."""

    folder: Path

    @classmethod
    def copy(cls, folder: Path) -> Checkout:
        shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
        for name in 'plugins', 'scenes', 'studies':  # where an installed package has them
            if not (folder / 'lingo_mi' / name).exists():
                (folder / 'lingo_mi' / name).symlink_to(Path('..') / name)
        return cls(folder)

    def test(self, file: str, seconds: float, *options: str) -> subprocess.CompletedProcess | None:
        """Run a test file; None where it takes longer."""
        environment = os.environ | dict(PYTHONPATH=str(self.folder), PYTHONDONTWRITEBYTECODE='1', DR_LOG_LEVEL='0')
        command = [sys.executable, *options, '-m', 'pytest', '-q', '-x', '-p', 'no:cacheprovider', file]
        with tempfile.TemporaryFile() as output:
            process = subprocess.Popen(
                command, cwd=self.folder, env=environment, stdout=output, stderr=output, start_new_session=True
            )
            try:
                code = process.wait(seconds)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, 9)
                process.wait()
                return None
            output.seek(0)
            return subprocess.CompletedProcess(command, code, output.read().decode(errors='replace'))

    def tried(self, mutant: Mutant, tests: list[tuple[str, float]]) -> str:
        """The test file that notices a mutant, '' where none does."""
        path = self.folder / mutant.file
        source = path.read_text(encoding='utf-8')
        path.write_text(source[: mutant.begin] + mutant.text + source[mutant.end :], encoding='utf-8')
        spent = 0.0
        try:
            for file, seconds in tests:
                if spent and spent + seconds > ENOUGH:
                    break
                started = time.monotonic()
                done = self.test(file, 5 * seconds + 30)
                spent += time.monotonic() - started
                if done is None or done.returncode not in (0, 5):
                    return file
            return ''
        finally:
            path.write_text(source, encoding='utf-8')


def measure_lines(checkouts: Queue[Checkout], known: dict, keep: Callable[[dict], object]) -> dict:
    """Seconds of every test file, and the lines of the package that it executes: {file: {seconds, lines: {file: [line]}}}.

    known   what was measured before
    keep    called with all that is known after every file
    """
    import coverage

    files = sorted(
        str(p.relative_to(ROOT)) for p in (ROOT / 'tests').rglob('test_*.py') if p.name != 'test_examples.py'
    )

    def one(file):
        checkout = checkouts.get()
        data = checkout.folder / f'.coverage.{os.path.basename(file)}'
        started = time.monotonic()
        options = ('-m', 'coverage', 'run', f'--data-file={data}', '--source=lingo_mi')
        done = checkout.test(file, 900, *options)
        seconds = time.monotonic() - started
        checkouts.put(checkout)
        if done is None or done.returncode not in (0, 5):
            print(f'{file} is left out: it does not pass as it is', file=sys.stderr, flush=True)
            return
        found = coverage.CoverageData(str(data))
        found.read()
        top = checkout.folder.resolve()
        lines = {str(Path(p).resolve().relative_to(top)): sorted(found.lines(p) or []) for p in found.measured_files()}
        known[file] = dict(seconds=seconds, lines=lines)
        keep(dict(known))
        print(f'{file}: {seconds:.0f} s', file=sys.stderr, flush=True)

    with ThreadPoolExecutor(checkouts.qsize()) as pool:
        list(pool.map(one, [f for f in files if f not in known]))
    return known


def tests_of(mutant: Mutant, lines: dict) -> list[tuple[str, float]]:
    """Test files that execute a mutant's line, with their seconds: its own first, then those that import from its module, then
    those that name it, then the shortest.

    A constant over several lines counts as executed on its first alone: the last line before it that is executed stands for it.
    """
    own = Path(mutant.file).stem
    executed = {f: set(x['lines'].get(mutant.file, ())) for f, x in lines.items()}
    line = max((n for n in set().union(*executed.values()) if n <= mutant.line), default=0)
    found = [(f, lines[f]['seconds']) for f, x in executed.items() if line in x]

    def distance(file):
        text = (ROOT / file).read_text(encoding='utf-8')
        return not re.search(rf'\.{own} import\b', text), not re.search(rf'\b{own}\b', text)

    return sorted(found, key=lambda x: (own not in x[0], *distance(x[0]), x[1]))


def accepted() -> set[tuple[str, str, str]]:
    """Survivors that have a reason: (file, text of the line, change)."""
    return {(x['file'], x['line'], x['change']) for x in json.loads(ACCEPTED.read_text(encoding='utf-8'))}


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--count', type=int, default=300, help='mutants to try')
    p.add_argument('--seed', type=int, default=0, help='which ones')
    p.add_argument('--within', nargs='+', default=PLACES, metavar='PLACE', help='packages and modules of lingo_mi')
    p.add_argument('--jobs', type=int, default=2, help='copies of the checkout that work side by side')
    p.add_argument(
        '--lines', type=Path, metavar='FILE', help='what each test executes (JSON); measured if it is not there'
    )
    p.add_argument(
        '--outcomes',
        type=Path,
        metavar='FILE',
        help='what noticed which mutant (JSON); those noticed are not tried again',
    )
    p.add_argument('--report', type=Path, metavar='FILE', help='write the page there, too')
    args = p.parse_args()

    sources = [
        q
        for place in args.within
        for q in sorted((ROOT / 'lingo_mi').glob(place if '.' in place else f'{place}/**/*.py'))
    ]
    every = [m for q in sources for m in mutants(q)]
    random.Random(args.seed).shuffle(every)
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        checkouts: Queue[Checkout] = Queue()
        for i in range(args.jobs):
            checkouts.put(Checkout.copy(Path(folder) / str(i)))
        known = json.loads(args.lines.read_text()) if args.lines and args.lines.exists() else {}
        lines = measure_lines(checkouts, known, lambda x: args.lines and args.lines.write_text(json.dumps(x)))
        reasons = accepted()
        chosen = [m for m in every if (m.file, m.around, m.change) not in reasons][: args.count]

        noticed = json.loads(args.outcomes.read_text()) if args.outcomes and args.outcomes.exists() else {}

        def one(mutant):
            if mutant.key in noticed:
                return noticed[mutant.key]
            checkout = checkouts.get()
            try:
                by = checkout.tried(mutant, tests_of(mutant, lines))
                if by:
                    noticed[mutant.key] = by
                if args.outcomes:
                    args.outcomes.write_text(json.dumps(noticed, indent=1))
            finally:
                checkouts.put(checkout)
            print(f'{"noticed " if by else "SURVIVED"} {mutant.file}:{mutant.line}  {mutant.change}  {by}', flush=True)
            return by

        with ThreadPoolExecutor(args.jobs) as pool:
            outcomes = list(pool.map(one, chosen))
    minutes = (time.monotonic() - started) / 60
    share = sum(map(bool, outcomes)) / max(len(outcomes), 1)
    page = _page(
        chosen, outcomes, f'{len(every):,} possible; {len(chosen)} tried, seed {args.seed}, {minutes:.0f} minutes'
    )
    print(page)
    if args.report:
        args.report.write_text(page, encoding='utf-8')
    return int(share < NEEDED)


def _page(chosen, outcomes, title):
    by_place: dict[str, list[bool]] = {}
    for mutant, by in zip(chosen, outcomes):
        by_place.setdefault(mutant.file.split('/')[1], []).append(bool(by))
    rows = [f'| {place} | {len(x)} | {sum(x)} | {sum(x) / len(x):.0%} |' for place, x in sorted(by_place.items())]
    noticed = sum(map(bool, outcomes))
    rows.append(f'| all | {len(outcomes)} | {noticed} | {noticed / max(len(outcomes), 1):.0%} |')
    left = [f'- `{m.file}:{m.line}` `{m.change}`' for m, by in zip(chosen, outcomes) if not by]
    table = ['| in | mutants | noticed | share |', '|---|---:|---:|---:|', *rows]
    return '\n'.join([f'# Mutants: {title}', '', *table, '', 'Survivors:', '', *(left or ['none']), ''])


if __name__ == '__main__':
    sys.exit(main())
