"""Bounds of the Gaussians' standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lingo_mi.fitting.options.part import Part, require


@dataclass(frozen=True)
class ScaleBounds(Part):
    """Bounds of standard deviations, in the normalised frame (R2-Gaussian: 5e-4 and 0.5 of the longest side, which is 2).

    Parameters
    ----------
    scale_min, scale_max : float
        Least and largest standard deviation; scale_min < scale_max.

    Raises
    ------
    InputError
        For bounds out of order or out of range.

    Examples
    --------
    `lm.Fast().changed(scale_min=2e-3)`
    """

    RANGES: ClassVar = dict.fromkeys(('scale_min', 'scale_max'), (1e-9, 1e3))

    scale_min: float = 1e-3
    scale_max: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        require(self.scale_min < self.scale_max, 'scale_min must be below scale_max')
