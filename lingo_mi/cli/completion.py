"""The text of `lingo-mi --print-completion SHELL`: a script by which a shell completes commands, options and files.

lingo-mi --print-completion bash > ~/.local/share/bash-completion/completions/lingo-mi
lingo-mi --print-completion zsh > ~/.zfunc/_lingo-mi     # a folder of $fpath
lingo-mi --print-completion fish > ~/.config/fish/completions/lingo-mi.fish
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lingo_mi.cli import COMMANDS
from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError


def print_script(arguments: Sequence[str]) -> None:
    """Print the script for the shell that the arguments name. Raises InputError without it or without shtab."""
    try:
        import shtab  # pyright: ignore[reportMissingImports] - optional
    except ImportError:
        raise InputError("completion needs the package shtab: pip install 'lingo_mi[completion]'") from None
    shells = shtab.SUPPORTED_SHELLS
    if len(arguments) != 1 or arguments[0] not in shells:
        raise InputError(f'--print-completion takes the name of a shell: {", ".join(shells)}')
    print(shtab.complete(whole_parser(shtab.FILE), shell=arguments[0]))


def whole_parser(files: Any) -> Parser:
    """One parser of all commands. files   what shtab completes names of files by"""
    whole = Parser(prog='lingo-mi')
    whole.add_argument('--version', action='store_true', help='versions of all that matters')
    whole.add_argument('--print-completion', metavar='SHELL', help='a script that completes commands and options')
    commands = whole.add_subparsers(dest='command')
    for name, command in COMMANDS.items():
        subparser = importlib.import_module(f'lingo_mi.cli.{command.module}').parser()
        for action in subparser._actions:
            if _names_a_file(action):
                action.complete = files
        commands.add_parser(name, parents=[subparser], add_help=False, help=command.does)
    return whole


def _names_a_file(action: argparse.Action) -> bool:
    """Return whether a file may be meant: any word that is neither a number nor one of a few."""
    return action.nargs != 0 and action.choices is None and action.type in (None, Path)
