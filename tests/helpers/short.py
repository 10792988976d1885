"""The short form of the tests: a choice among many like cases."""

from collections.abc import Iterable, Mapping

import pytest


def short(cases: Mapping, names: Iterable[str]):
    """Parameters for all cases, by name. The short form runs those with these names, and the others are thorough.

    A tuple holds the values of several arguments.
    """
    names = set(names)
    assert names <= cases.keys(), f'no such cases: {names - cases.keys()}'

    def param(name, case):
        values = case if isinstance(case, tuple) else (case,)
        return pytest.param(*values, id=name, marks=() if name in names else pytest.mark.thorough)

    return [param(name, case) for name, case in cases.items()]
