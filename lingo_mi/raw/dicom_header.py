"""The content of a DICOM header for geometries: a value, or the one line that names what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, shown


def floats(value: Any) -> np.ndarray | None:
    """Numbers of a header, float64 [m]; None if they are missing or empty.

    Raises
    ------
    ValueError
        For anything else.
    """
    if value is None or np.size(value) == 0 or (isinstance(value, str) and not value.strip()):
        return None
    return np.atleast_1d(np.asarray(value, float))


def needed(where: Path | str, name: str, values: np.ndarray | None, count: int) -> np.ndarray:
    """`count` numbers of an attribute `name`, which a geometry needs.

    Raises
    ------
    InputError
        If they are missing, more or fewer, or not finite.
    """
    remedy = 'say where the frames were taken: geometry=FILE'
    if values is None:
        raise InputError(f'{where}: the DICOM attribute {name} is missing; {remedy}')
    if values.shape != (count,) or not np.isfinite(values).all():
        wanted = 'one finite number' if count == 1 else f'{count} finite numbers'
        raise InputError(
            f'{where}: the DICOM attribute {name} must be {wanted}, not {shown(values.tolist())}; {remedy}'
        )
    return values
