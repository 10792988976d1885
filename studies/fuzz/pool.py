"""Runs cases in children, which are replaced when they die or take too long."""

from __future__ import annotations

import os
import queue
import select
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from studies.fuzz.readers import case, reader, write

CHUNK = 100  # cases that a child is given at once


@dataclass
class Tally:
    """Counts of the outcomes of one reader's cases."""

    values: int = 0
    refused: int = 0
    seconds: float = 0.0
    failures: dict[int, str] = field(default_factory=dict)  # what is wrong, by the case's number

    @property
    def cases(self) -> int:
        return self.values + self.refused + len(self.failures)

    def add(self, number: int, result: str) -> None:
        if result == 'value':
            self.values += 1
        elif result == 'refused':
            self.refused += 1
        else:
            self.failures[number] = result


def _command(memory: int) -> list[str]:
    return [sys.executable, '-m', 'studies.fuzz.child', str(memory)]


class _Child:
    """A process that reads cases: see `studies.fuzz.child`."""

    def __init__(self, memory: int):
        self.process = subprocess.Popen(
            _command(memory),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ
            | {'PYTHONPATH': os.pathsep.join(sys.path), 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'},
        )
        self.rest = b''

    def lines(self, seconds: float) -> list[str] | None:
        """The lines that have come, None after `seconds` without any; raises EOFError where the process has died."""
        out = self.process.stdout
        assert out is not None
        if not select.select([out], [], [], seconds)[0]:
            return None
        got = os.read(out.fileno(), 1 << 16)
        if not got:
            raise EOFError
        *whole, self.rest = (self.rest + got).split(b'\n')
        return [line.decode('utf-8', 'replace') for line in whole]

    def ask(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode())
        self.process.stdin.flush()

    def stop(self, hangs: bool = True) -> int:
        """Ends the process; returns its exit code."""
        try:
            code = self.process.wait(0 if hangs else 5)  # how it died
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()
        return code


def run(
    names: Iterable[str],
    cases: int,
    seed: int,
    *,
    processes: int = 2,
    seconds: float = 10.0,
    memory: int = 1 << 30,
    report: Callable[[int], None] = lambda done: None,
) -> dict[str, Tally]:
    """Tallies by reader of `cases` cases each.

    Parameters
    ----------
    seconds : float
        Seconds that a case may take.
    memory : int
        Bytes of address space that a child may take for its cases.
    report : callable
        It is called with the number of finished cases.
    """
    tallies = {name: Tally() for name in names}
    work: queue.SimpleQueue = queue.SimpleQueue()
    # All readers' first cases first, so that a broken one is seen early.
    for first in range(0, cases, CHUNK):
        for name in tallies:
            work.put((name, first, min(first + CHUNK, cases)))
    lock, done, trouble = threading.Lock(), Counter(), []

    def drive() -> None:
        child = None
        try:
            while True:
                try:
                    name, first, last = work.get_nowait()
                except queue.Empty:
                    return
                while first < last:
                    child = child or _Child(memory)
                    began = time.monotonic()
                    results, child, first = _chunk(child, name, seed, first, last, seconds)
                    with lock:
                        tallies[name].seconds += time.monotonic() - began
                        for number, result in results.items():
                            tallies[name].add(number, result)
                with lock:
                    done['cases'] = sum(tally.cases for tally in tallies.values())
                    report(done['cases'])
        except BaseException as error:
            trouble.append(error)
        finally:
            if child is not None:
                child.stop()

    threads = [threading.Thread(target=drive) for _ in range(processes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if trouble:
        raise trouble[0]
    return tallies


def _chunk(child, name, seed, first, last, seconds):
    """Has a child read the cases from `first` to before `last`. Returns the results by number, the child, None if it has died,
    and the next case."""
    child.ask(f'{name}\t{seed}\t{first}\t{last}\n')
    at, patience, died = first - 1, seconds + 60, None  # the first case waits for the imports
    results = {}
    while at < last - 1 or at not in results:
        try:
            lines = child.lines(patience)
        except EOFError:
            died, lines = 'the process died', []
            break
        if lines is None:
            died = f'no answer within {seconds:g} seconds'
            break
        for line in lines:
            what, number, *result = line.split(' ', 2)
            at = int(number)
            if what == 'end':
                results[at] = result[0]
        patience = seconds
    if died:
        code = child.stop(hangs=lines is None)
        if at < first:
            raise RuntimeError(f'{name}: the child does not start ({died}, exit code {code})')
        results[at] = died + (f', exit code {code}' if lines is not None else '')
        child = None
    return results, child, at + 1


def save_case(name: str, seed: int, number: int, what: str, folder: Path) -> Path:
    """Writes the files of a case, to be read again, and what went wrong; returns where."""
    index, file, content = case(name, Random(f'{seed}/{name}/{number}'))
    sample = reader(name)[1][index]
    home = folder / f'{name.replace(", ", "-").replace(" ", "-")}-{seed}-{number}'
    write(sample, home / 'files')
    (home / 'files' / file).write_bytes(content)
    (home / 'what.txt').write_text(
        f'{name}: {sample.target or "the folder"}\nmutated: {file}\n{what}\n', encoding='utf-8'
    )
    return home
