"""`.. command:: fit` is what `lingo-mi fit --help` prints."""

import contextlib
import io
import sys

from docutils import nodes
from docutils.parsers.rst import Directive

from lingo_mi.cli import run


class Command(Directive):
    """The help of one command as a block of text."""

    required_arguments = 1

    def run(self):
        text = help_of(self.arguments[0])
        return [nodes.literal_block(text, text, language='text')]


def help_of(command: str) -> str:
    """What a command prints with --help."""
    printed, arguments = io.StringIO(), sys.argv
    sys.argv = [f'lingo-mi {command}', '--help']
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            run(command)
    finally:
        sys.argv = arguments
    return printed.getvalue()


def setup(app):
    app.add_directive('command', Command)
    return {'parallel_read_safe': True}
