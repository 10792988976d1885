"""The units of a volume's file: attenuation per mm, per cm, or Hounsfield units."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from lingo_mi.common.errors import InputError, shown

PER_CM = 0.1  # of a value per mm: 10 per cm
_HU = re.compile(r'HU, water ([-+.e\d]+) per mm')


@dataclass(frozen=True)
class Unit:
    """A unit of attenuation.

    Parameters
    ----------
    name : {'1/mm', '1/cm', 'hu'}
    mu_water : float or None
        Attenuation of water, 1/mm, for Hounsfield units: HU = 1000 (mu / mu_water - 1).
    """

    name: str = '1/mm'
    mu_water: float | None = None

    def values(self, density: np.ndarray) -> np.ndarray:
        """Densities per mm in this unit, float32."""
        if self.name == '1/mm':
            return density
        if self.mu_water is None:
            return np.float32(1 / PER_CM) * density
        return np.float32(1000 / self.mu_water) * density - np.float32(1000)

    def densities(self, values: np.ndarray) -> np.ndarray:
        """Values in this unit as densities per mm, float32."""
        if self.name == '1/mm':
            return values
        if self.mu_water is None:
            return np.float32(PER_CM) * values
        return np.float32(self.mu_water / 1000) * (values + np.float32(1000))

    @property
    def description(self) -> str:
        """The unit's text in a file."""
        if self.mu_water is not None:
            return f'HU, water {self.mu_water!r} per mm'
        return 'density per cm' if self.name == '1/cm' else 'density per mm'

    @classmethod
    def described(cls, text: str) -> Unit | None:
        """The unit that a file's description names; None if it names another."""
        if match := _HU.fullmatch(text):
            return cls('hu', float(match[1]))
        return {PER_MM.description: PER_MM, 'density per cm': cls('1/cm')}.get(text)


PER_MM = Unit()


def unit_of(units: str, mu_water: float | None = None) -> Unit:
    """The unit by its name.

    Raises
    ------
    InputError
        For another name, for Hounsfield units without `mu_water`, and for one that is not positive or goes with no unit.
    """
    if units not in ('1/mm', '1/cm', 'hu'):
        raise InputError(f"units must be '1/mm', '1/cm' or 'hu', not {shown(units)}")
    if units != 'hu':
        if mu_water is not None:
            raise InputError("mu_water, the attenuation of water, is for units='hu'; leave it out")
        return Unit(units)
    if mu_water is None:
        raise InputError(
            "units='hu' needs the attenuation of water in 1/mm: give mu_water=0.0206, the value at 60 keV, or yours"
        )
    try:
        water = float(mu_water)
    except (TypeError, ValueError):
        water = float('nan')
    if not (np.isfinite(water) and water > 0):
        raise InputError(f'mu_water must be positive, in 1/mm, not {shown(mu_water)}; water at 60 keV has 0.0206')
    return Unit('hu', water)
