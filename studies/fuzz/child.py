"""Reads case after case and says on the standard output what came of each: `python -m studies.fuzz.child`.

Lines in: reader, seed, first and last case, separated by tabs. Lines out: `start CASE` before a case, `end CASE RESULT` after it;
the result is value, refused, or what is wrong.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from random import Random

from lingo_mi.common.errors import InputError
from studies.fuzz.readers import case, reader, write


def verdict(name: str, folder: Path, rng: Random) -> str:
    """Return the verdict of a reader on one case, whose files are written below `folder`."""
    index, file, content = case(name, rng)
    read, samples = reader(name)
    home = folder / f'{name.replace(", ", "-").replace(" ", "-")}{index}'
    if not home.exists():
        write(samples[index], home)
    path = home / file
    original = path.read_bytes()
    path.write_bytes(content)
    try:
        return outcome(lambda: read(home / samples[index].target, rng))
    finally:
        path.write_bytes(original)


def outcome(call) -> str:
    """value, refused, or what is wrong with how `call` fails."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            call()
        return 'value'
    except InputError as error:
        text = str(error)
        if not text.isprintable() or len(text.splitlines()) != 1:
            return f'message of {len(text.splitlines())} lines: {text[:200]!r}'
        return 'refused'
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        message = ' '.join(str(error).split())[:200]
        return f'{type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {message}'


def limit_memory(more: int) -> None:
    """Lets this process take `more` bytes of address space than it has now."""
    import resource

    taken = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + more, taken + more))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main() -> None:
    answers = os.fdopen(os.dup(1), 'w', buffering=1)
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    more, limited = int(sys.argv[1]), False
    place = '/dev/shm' if os.access('/dev/shm', os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=place) as folder, contextlib.suppress(BrokenPipeError):
        for line in sys.stdin:
            name, seed, first, last = line.rstrip('\n').split('\t')
            reader(name)
            if not limited:
                limit_memory(more)
                limited = True
            for number in range(int(first), int(last)):
                answers.write(f'start {number}\n')
                result = verdict(name, Path(folder), Random(f'{seed}/{name}/{number}'))
                answers.write(f'end {number} {result}\n')


if __name__ == '__main__':
    main()
