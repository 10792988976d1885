"""`.. command:: fit` is what `lingo-mi fit --help` prints; `.. study:: tables`, what `python -m studies.tables --help` does."""

import contextlib
import io
import runpy
import sys
from collections.abc import Callable

from docutils import nodes
from docutils.parsers.rst import Directive

from lingo_mi.cli import run


class Command(Directive):
    """The help of one command as a block of text."""

    required_arguments = 1

    def run(self):
        return [block(f'lingo-mi {self.arguments[0]}', lambda: run(self.arguments[0]))]


class Study(Directive):
    """The help of one study as a block of text."""

    required_arguments = 1

    def run(self):
        module = f'studies.{self.arguments[0]}'
        return [block(module, lambda: runpy.run_module(module, run_name='__main__'))]


def block(program: str, main: Callable[[], object]) -> nodes.literal_block:
    """What a program prints with --help."""
    printed, arguments = io.StringIO(), sys.argv
    sys.argv = [program, '--help']
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            main()
    finally:
        sys.argv = arguments
    return nodes.literal_block(printed.getvalue(), printed.getvalue(), language='text')


def setup(app):
    app.add_directive('command', Command)
    app.add_directive('study', Study)
    return {'parallel_read_safe': True}
