"""Nikon's .xtekct: the circle of an XT H scanner, and the level of its unattenuated beam."""

from __future__ import annotations

import re
from functools import partial
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.raw.recording import Taken
from lingo_mi.raw.settings import Settings
from lingo_mi.storage.file_access import reading


def read_xtekct(path: PathLike | str) -> Taken:
    """The circular scan that it describes, and the white level in counts.

    Seen from the source, Nikon's columns run to the left. CentreOfRotationTop and -Bottom, mm on the panel, become COR.

    Raises
    ------
    InputError
        If the file is missing or damaged, or lacks a number.
    """
    section = 'XTekCT'
    settings = Settings.read(path, '.xtekct', section)
    number = partial(settings.number, section)
    n, DSO, DSD = settings.circle((section, 'Projections'), (section, 'SrcToObject'), (section, 'SrcToDetector'))
    top, bottom = number('CentreOfRotationTop', 0.0), number('CentreOfRotationBottom', 0.0)
    unread = [
        name
        for name in ('DetectorOffsetX', 'DetectorOffsetY', 'ObjectOffsetX', 'ObjectTilt', 'ObjectRoll')
        if number(name, 0.0)
    ]
    if top != bottom:
        unread.append('the slope between CentreOfRotationTop and CentreOfRotationBottom')
    settings.warn_unread(unread)
    values = dict(
        DSO=DSO,
        DSD=DSD,
        nDetector=[int(number('DetectorPixelsY')), int(number('DetectorPixelsX'))],
        dDetector=[number('DetectorPixelSizeY'), number('DetectorPixelSizeX')],
        angles=(number('InitialAngle', 0.0) + number('AngularStep') * np.arange(n)).tolist(),
    )
    if top + bottom:
        values['COR'] = (top + bottom) / 2 * DSO / DSD
    return Taken(values, columns=-1, white=number('WhiteLevel', 0.0) or None)


def read_numbers(path: PathLike | str) -> np.ndarray:
    """Numbers [n] of a text file: one a line, or the second column, after the number of the view, as angles in Nikon's .ang.

    Lines without a number at their start (a heading) are skipped.

    Raises
    ------
    InputError
        If none is left, for a line that goes on with something else, and for decimal commas.
    """
    values = []
    with reading(path):
        lines = Path(path).read_text(encoding='utf-8', errors='replace').splitlines()
    if _decimal_commas(lines):
        raise InputError(f'{path}: its numbers seem to have decimal commas; write decimal points')
    for number, line in enumerate(lines, 1):
        cells = line.replace(':', ' ').replace(',', ' ').replace(';', ' ').split()[:2]  # times may follow
        try:
            values += [float(cell) for cell in cells][-1:]
        except ValueError:
            if _is_number(cells[0]):
                raise InputError(f'{path}: line {number} has {shown(cells[1])} instead of a number') from None
    if not values or not np.isfinite(values).all():
        raise InputError(f'{path}: holds no numbers; write one a line')
    return np.array(values)


def _decimal_commas(lines):
    """Return whether commas are decimal: they stand beside another separator, or after something that does not count views."""
    rows = [re.split(r'[\s;:]+', line.strip()) for line in lines if re.match(r'\s*[-+]?\d', line)]
    if any(re.fullmatch(r'[-+]?\d+,\d+', cell) for row in rows for cell in row[1:2]):
        return True
    first = [row[0].split(',')[0] for row in rows if re.fullmatch(r'[-+]?\d+,\d+', row[0])]
    return len(first) > 1 and len({int(number) - k for k, number in enumerate(first)}) > 1


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True
