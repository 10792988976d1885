"""Methods by name, as on a command line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.parsing import nearest
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.fitting.methods.lingo import LINGO
from lingo_mi.fitting.methods.naf import NAF
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.methods.splatting import GaussianSplatting, XGaussian
from lingo_mi.fitting.options.part import kinds_of

METHODS: dict[str, Method] = {kind.name: kind() for kind in (Fast, LINGO, R2, GaussianSplatting, XGaussian, NAF)}
# Those of Gaussians with densities.
CLOUDS = tuple(name for name, method in METHODS.items() if method.makes_gaussians and method.makes_volume)


def method_of(text: str, **values: Any) -> Method:
    """The method `name` or `name:option=value,...`, also one of another package that is imported.

    Parameters
    ----------
    text : str
        Its options take precedence over `values`.
    values
        Options by flat name.

    Raises
    ------
    InputError
        For an unknown method or option.

    Examples
    --------
    >>> method_of('lingo:V_S=1,rate_density=1e-2,1e-3', iterations=800).iterations
    800
    """
    name, _, changes = text.partition(':')
    kinds = kinds_of(Method)
    if name not in kinds:
        raise InputError(
            f'there is no method {shown(name)}{nearest(name, kinds)}; use one of {", ".join(METHODS | kinds)}'
        )
    options = {option: value for option, _, value in (change.partition('=') for change in changes_of(changes))}
    return kinds[name]().changed(**values).changed(**options)


def known_options(text: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """All options of a method, by its name as `method_of` takes it, with the kinds of parts that `values` choose.

    Values that are not options are passed over: `start=masks` brings options that other starts do not have.
    """
    accepted = method_of(text).flat()
    return method_of(text, **{name: value for name, value in values.items() if name in accepted}).flat()


def changes_of(text: str) -> list[str]:
    """'option=value,...' one by one. Not every comma ends an option: rates are two numbers."""
    return [change for change in re.split(r',(?=\w+=)', text) if change]
