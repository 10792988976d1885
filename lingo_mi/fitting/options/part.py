"""Options as frozen dataclasses that check themselves, and their flat names.

A method has parts, which are its fields: `LINGO().loss.lambda_tv`. Command lines and files use flat names, which are unique
within a method: `LINGO().changed(lambda_tv=0.1)`, `-D lambda_tv=0.1`. A part that comes in kinds, such as the start, has the
name of its kind for a value: `LINGO().changed(start='edges')`.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

from typing_extensions import Self

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.parsing import checked, nearest, parse, require_ranges

MOST_STEPS = 1e9  # ranges end far beyond useful values, at the limits of float32 or of the time of a fit


@dataclass(frozen=True)
class Part:
    """A dataclass of options, checked when it is made.

    Attributes
    ----------
    RANGES : dict
        The least and the largest number, by field.
    CHOICES : dict
        The allowed texts, by field.
    name : str
        Name of a kind of this part, for command lines and files; '' if the part comes in one kind.

    Raises
    ------
    InputError
        For a value of the wrong type, out of its range, or that contradicts another.
    """

    RANGES: ClassVar[dict] = {}
    CHOICES: ClassVar[dict] = {}
    name: ClassVar[str] = ''

    def __post_init__(self):
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(f.default, tuple) and isinstance(value, list):
                object.__setattr__(self, f.name, tuple(value))
            if isinstance(f.default, Part):
                kind = family(type(f.default)) if f.default.name else type(f.default)
                if not isinstance(value, kind):
                    raise InputError(
                        f'{f.name} must be of class {kind.__name__}, such as {shown(f.default)}, not {shown(value)}'
                    )
        require_ranges(self, **self.RANGES)
        for name, choices in self.CHOICES.items():
            require(getattr(self, name) in choices, f'{name} is {_or(choices)}, not {shown(getattr(self, name))}')

    def flat(self) -> dict[str, Any]:
        """All values by their flat names."""
        return dict(self._flat())

    def _flat(self) -> Iterator[tuple[str, Any]]:
        for f in fields(self):
            value = getattr(self, f.name)
            if not isinstance(value, Part):
                yield f.name, value
                continue
            if value.name:
                yield f.name, value.name
            yield from value._flat()

    def changed(self, /, **values: Any) -> Self:
        """A copy with other values, by flat name. Values may be texts, as from a command line.

        Raises
        ------
        InputError
            For an unknown name, which says what is near, or a value of the wrong kind.

        Examples
        --------
        >>> from lingo_mi.fitting.methods.r2 import R2
        >>> R2().changed(iterations=800, lambda_tv='0.1').loss.lambda_tv
        0.1
        """
        new, values = self._with_kinds(values)
        accepted = new.flat()
        for name in values:
            if name not in accepted:
                raise InputError(
                    f'unknown setting {name!r}{nearest(name, accepted) or f": see the documentation of {type(self).__name__}"}'
                )
        return new._changed(values)

    def _with_kinds(self, values: dict[str, Any]) -> tuple[Self, dict[str, Any]]:
        """A copy whose parts are of the kinds that `values` name, and the other values. A new part keeps what it shares."""
        changes: dict[str, Any] = {}
        for f in fields(self):
            part = getattr(self, f.name)
            if isinstance(part, Part) and part.name and f.name in values:
                kinds = kinds_of(type(part))
                if (wanted := values[f.name]) not in list(kinds):
                    raise InputError(f'{f.name} is {_or(kinds)}, not {shown(wanted)}')
                if wanted != part.name:
                    shared = {g.name for g in fields(kinds[wanted])} & {g.name for g in fields(part)}
                    usual = {g.name: g.default for g in fields(part)}
                    unchanged = {k: getattr(part, k) for k in shared if getattr(part, k) != usual[k]}
                    changes[f.name] = kinds[wanted](**unchanged)
                values = {k: v for k, v in values.items() if k != f.name}
        return (replace(self, **changes) if changes else self), values

    def _changed(self, values: dict[str, Any]) -> Self:
        changes: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, Part):
                if mine := {k: v for k, v in values.items() if k in value.flat()}:
                    changes[f.name] = value._changed(mine)
            elif f.name in values:
                new = values[f.name]
                changes[f.name] = (parse if isinstance(new, str) else checked)(f'setting {f.name}', new, f.default)
        return replace(self, **changes) if changes else self


def family(kind: type[Part]) -> type[Part]:
    """The class that all kinds of a part derive from: the one right below `Part`."""
    line = [c for c in kind.__mro__ if issubclass(c, Part)]
    return line[line.index(Part) - 1] if kind is not Part else Part


def kinds_of(kind: type[Part]) -> dict[str, type]:
    """All kinds of a part by name, including kinds from other packages."""

    def below(cls: type) -> Iterator[type]:
        for sub in cls.__subclasses__():
            yield sub
            yield from below(sub)

    kinds: dict[str, type] = {}
    for cls in (family(kind), *below(family(kind))):
        if cls.__dict__.get('name') and not inspect.isabstract(cls):
            kinds.setdefault(cls.name, cls)  # the first of a name, which is this package's
    return kinds


def require(good: Any, message: str) -> None:
    """Raise InputError with the message unless something is good."""
    if not good:
        raise InputError(message)


def _or(choices) -> str:
    *most, last = map(repr, choices)
    return f'{", ".join(most)} or {last}' if most else last
