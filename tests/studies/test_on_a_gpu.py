"""`python -m studies.on_a_gpu`: its commands, its limits of time, and a rehearsal of its quickest parts on the CPU."""

import argparse
import ast
import importlib
import importlib.util
import os
import runpy
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from lingo_mi.common.errors import InputError
from studies import on_a_gpu
from studies.on_a_gpu import TOTAL, VARIANT, Outcome, Part, all_parts, run_parts, scenes

ROOT = Path(__file__).parents[2]
PARTS = {part.name: part for parts in all_parts(Path('out')) for part in parts}


class ParsedError(BaseException):
    """Ends a command when its arguments are parsed."""


@pytest.fixture
def study(tmp_path, monkeypatch):
    """Run it with its results in `tmp_path`: its exit code."""

    def study(*args):
        monkeypatch.setattr(sys, 'argv', ['on_a_gpu', '--out', str(tmp_path), *args])
        return on_a_gpu.main()

    return study


@pytest.fixture
def parse(monkeypatch):
    """Parse the arguments of a command `-m MODULE ...`: the ones that its parser does not know."""
    parse_known_args = argparse.ArgumentParser.parse_known_args

    def stopped(self, args=None, namespace=None):
        _, unknown = parse_known_args(self, args, namespace)
        raise ParsedError(unknown)

    def parse(command):
        monkeypatch.setattr(sys, 'argv', list(command[1:]))
        with pytest.raises(ParsedError) as parsed:
            runpy.run_module(command[1], run_name='__main__', alter_sys=True)
        return parsed.value.args[0]

    monkeypatch.setattr(argparse.ArgumentParser, 'parse_known_args', stopped)
    return parse


def imported(name):
    """The modules and names that a module of this checkout imports anywhere, also in its functions."""
    spec = importlib.util.find_spec(name)
    assert spec is not None and spec.origin is not None, name
    path = Path(spec.origin)
    path = path.with_name('__main__.py') if path.name == '__init__.py' else path
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith(('lingo_mi', 'studies')):
            yield from ((node.module, alias.name) for alias in node.names)


@pytest.mark.thorough
@pytest.mark.parametrize('name', [name for name in PARTS if name != 'tests'])
def test_commands_parse_and_their_modules_import(name, parse):
    part = PARTS[name]
    assert not parse(part.command) and not parse(part.small)
    module = part.command[1]
    if module == 'lingo_mi':
        module = f'lingo_mi.cli.{part.command[2]}'
    for where, what in imported(module):
        assert hasattr(importlib.import_module(where), what) or importlib.util.find_spec(f'{where}.{what}')


@pytest.mark.thorough
def test_tests_are_there():
    done = subprocess.run(
        [sys.executable, *PARTS['tests'].command, '--collect-only', '-q'], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr


@pytest.mark.thorough
@pytest.mark.posix
def test_rehearsal(study, tmp_path, monkeypatch):
    """The quickest parts run on the CPU, and leave their tables; the scenes need no data."""
    monkeypatch.delenv('LINGO_MI_DATA', raising=False)
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')]))
    monkeypatch.chdir(ROOT)
    assert study('--variant', 'llvm_ad_mono', '--parts', 'fit', 'bench_step', 'operator') == 0
    summary = (tmp_path / 'summary.md').read_text()
    assert summary.count('| done |') == 3
    assert 'foot, chest, shepp_logan. LINGO_MI_DATA does not name a folder with chest_lidc0314 and engine' in summary
    assert 'lingo_mi, Joseph' in (tmp_path / 'operator' / 'operator.csv').read_text()
    assert 'A step takes' in (tmp_path / 'bench_step.txt').read_text()


def test_limits_fit_into_nine_minutes():
    assert sum(max(part.seconds for part in parts) for parts in all_parts(Path('out'))) <= TOTAL <= 510


def test_scenes(tmp_path, monkeypatch):
    """Phantoms take the place of volumes that are not there."""
    monkeypatch.delenv('LINGO_MI_DATA', raising=False)
    assert scenes() == ['foot', 'chest', 'shepp_logan']
    monkeypatch.setenv('LINGO_MI_DATA', str(tmp_path))
    (tmp_path / 'engine.nii.gz').touch()
    assert scenes() == ['engine', 'foot', 'chest']
    (tmp_path / 'chest_lidc0314.nii.gz').touch()
    assert scenes() == ['chest_lidc0314', 'engine', 'foot']


@pytest.mark.posix
def test_parts_side_by_side_that_fail_and_run_out_of_time(tmp_path):
    """A part that runs out of time ends with what it has started."""
    child = tmp_path / 'child'
    forks = f'import os, time; pid = os.fork(); pid and open({str(child)!r}, "w").write(str(pid)); time.sleep(60)'
    parts = [Part('fails', 1, ('-c', 'print(1); raise SystemExit(3)'), ()), Part('stays', 1, ('-c', forks), ())]
    begun = time.perf_counter()
    outcomes = {outcome.name: outcome for outcome in run_parts(parts, 3, tmp_path, VARIANT, None, False)}
    assert outcomes['fails'].result == 'failed (exit code 3)' and outcomes['stays'].result == 'out of time'
    assert isinstance(outcomes['stays'], Outcome) and 3 <= outcomes['stays'].seconds < time.perf_counter() - begun < 30
    assert (tmp_path / 'fails.txt').read_text() == '1\n'
    left = int(child.read_text())
    assert not psutil.pid_exists(left) or psutil.Process(left).status() == psutil.STATUS_ZOMBIE


def test_a_part_leaves_its_time_to_the_next(study, tmp_path, monkeypatch):
    """The next part has its own limit and what the others have left of theirs."""
    limits = []

    def run_parts(parts, limit, *_):
        limits.append(limit)
        yield from (Outcome(part.name, 0, 'done') for part in parts)

    monkeypatch.setattr(on_a_gpu, 'run_parts', run_parts)
    assert study() == 0
    seconds = [max(part.seconds for part in parts) for parts in all_parts(tmp_path)]
    assert limits == pytest.approx([sum(seconds[: i + 1]) for i in range(len(seconds))], abs=5)
    assert (tmp_path / 'summary.md').read_text().count('| done |') == len(PARTS)


def test_bad_input(study):
    with pytest.raises(InputError, match='--parts nothing: there is no such part; the parts are tests'):
        study('--parts', 'nothing')
    with pytest.raises(InputError, match='/nothing: is not a program'):
        study('--stand-in', '/nothing')
