"""The files of settings that scanners write: names and values in sections."""

from __future__ import annotations

import configparser
import warnings
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.limits import MOST_VIEWS
from lingo_mi.storage.file_access import one_line, reading


@dataclass(frozen=True)
class Settings:
    """A file `path` of the kind `kind`, such as .xtekct, by section and name; upper and lower case are the same in names."""

    path: Path
    kind: str
    values: configparser.ConfigParser

    @classmethod
    def read(cls, path: PathLike | str, kind: str, section: str) -> Settings:
        """Read a file that must have `section`.

        Raises
        ------
        InputError
            If it is missing or damaged, or has no such section.
        """
        path = Path(path)
        parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters='=', allow_no_value=True)
        with reading(path):
            try:
                parser.read_string(path.read_text(encoding='utf-8', errors='replace'))
            except configparser.Error as error:
                raise InputError(f'{path}: is not a {kind} file ({one_line(error)[:120]})') from None
        if not parser.has_section(section):
            raise InputError(f'{path}: has no section [{section}]; give the {kind} of the scan')
        return cls(path, kind, parser)

    def text(self, section: str, name: str) -> str:
        """A value, empty if it is missing."""
        return (self.values.get(section, name, fallback='') or '').strip()

    def number(self, section: str, name: str, default: float | None = None) -> float:
        """A number.

        Raises
        ------
        InputError
            If it is missing without a default, or is not a number.
        """
        text = self.text(section, name)
        if not text and default is not None:
            return default
        if not text:
            raise InputError(f'{self.path}: {name} is missing; give the {self.kind} of the scan')
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise InputError(f'{self.path}: {name} must be a number, not {text!r}')
        return value

    def circle(self, views: tuple[str, str], DSO: tuple[str, str], DSD: tuple[str, str]) -> tuple[int, float, float]:
        """The number of views, DSO and DSD by their sections and names.

        Raises
        ------
        InputError
            If they do not make a scan.
        """
        n, near, far = (self.number(*place) for place in (views, DSO, DSD))
        if not 1 <= n <= MOST_VIEWS or not far >= near > 0:
            raise InputError(f'{self.path}: needs {views[1]} from 1 to {MOST_VIEWS} and {DSD[1]} >= {DSO[1]} > 0')
        return int(n), near, far

    def warn_unread(self, names: list[str]) -> None:
        """Warn that what these names say of the geometry is not read."""
        if names:
            warnings.warn(
                f'{self.path}: {", ".join(names)} is not read: calibrate the scan if its axis is off', stacklevel=3
            )
