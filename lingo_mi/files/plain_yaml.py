"""YAML of plain data: without aliases, names given twice, deep nesting, and more values than a scan needs.

`yaml.safe_load` alone takes all of these: nine lines of aliases stand for a billion values, and of two equal names one is lost.
"""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path
from typing import Any

import yaml

from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import one_line, reading

MOST_BYTES, MOST_VALUES, DEEPEST, LONGEST_TEXT = 8 << 20, 250_000, 16, 10_000


class _Loader(yaml.SafeLoader):
    """Refuses while it reads: an alias may stand for a value that is too large to be built, or holds itself."""

    values = depth = 0

    def compose_node(self, parent, index):
        event: Any = self.peek_event()
        self.values += 1
        if isinstance(event, yaml.AliasEvent):
            self._refuse('an alias (*), which is not read; write the value itself', event)
        if self.values > MOST_VALUES:
            self._refuse(f'more than {MOST_VALUES} values; put poses into a file of their own', event)
        if self.depth >= DEEPEST:
            self._refuse(f'values nested more than {DEEPEST} deep', event)
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_TEXT:
            self._refuse(f'a text of more than {LONGEST_TEXT} characters', event)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node, deep=False):
        names = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in names:
                    self._refuse(f'the name {key.value} twice; remove one of them', key)
                names.add(key.value)
        return super().construct_mapping(node, deep)

    def _refuse(self, what, at):
        raise InputError(f'line {at.start_mark.line + 1} holds {what}')


def read_yaml(path: PathLike | str) -> Any:
    """The dictionaries, lists, texts and numbers of a file.

    Raises
    ------
    InputError
        If it is missing, no YAML, or holds what the module's title names.
    """
    try:
        with reading(path):
            if os.path.getsize(path) > MOST_BYTES:
                raise InputError(f'{path}: is larger than {MOST_BYTES >> 20} MiB; put poses into a file of their own')
            text = Path(path).read_text(encoding='utf-8')
    except UnicodeDecodeError as error:
        raise InputError(f'{path}: is not valid YAML ({one_line(error)}); correct it') from None
    try:
        return yaml.load(text, _Loader)
    except InputError as error:
        raise InputError(f'{path}: {error}') from None
    except Exception as error:  # values that look like numbers or dates, but are not, fail in many ways
        raise InputError(f'{path}: is not valid YAML ({one_line(error)}); correct it') from None
