"""Checks which Gaussians can be integrated, which of them accurately, and whether Dr.Jit can record the kernels."""

from __future__ import annotations

import warnings
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.errors import AccuracyWarning, InputError

# In the scene's units. Beyond these, float32 overflows or the projector's float64 has too few digits.
MOST_LENGTH, MOST_DENSITY, MOST_ASPECT = 1e12, 1e24, 1e7
SAFE_ASPECT = 1e6


def require_usable(centre: Any, scale: Any, rotation: Any, density: Any, where: str) -> bool:
    """Return whether all Gaussians of a cloud can be integrated accurately. Waits for the device.

    Warns with AccuracyWarning and returns False if a Gaussian can be integrated, but not accurately.

    Parameters
    ----------
    centre, scale, rotation, density
        As for `footprint.project`.
    where : str
        Name of the cloud, for messages.

    Raises
    ------
    InputError
        If one cannot be integrated: it is not finite, its quaternion is zero, or a scale is not positive or out of range.
    """
    with dr.suspend_grad():
        shortest, longest = dr.min(scale), dr.max(scale)
        turn = dr.squared_norm(rotation)
        sound = (
            dr.isfinite(dr.sum(centre) + dr.sum(scale) + density + turn)
            & (dr.max(dr.abs(centre)) <= MOST_LENGTH)
            & (longest <= MOST_LENGTH)
            & (shortest >= 1 / MOST_LENGTH)
            & (dr.abs(density) <= MOST_DENSITY)
            & (turn > 1e-30)
            & (longest <= MOST_ASPECT * shortest)
        )
        thin = longest > SAFE_ASPECT * shortest
        worst = dr.max(dr.select(sound, dr.select(thin, mi.UInt32(1), 0), 2))[0] if dr.width(sound) else 0
        if worst == 2:
            first = _first(~sound)
            raise InputError(
                f'Gaussian {first} of {where} is not usable: centre, density and rotation must '
                f'be finite, the quaternion not zero, the scales positive and at most {MOST_ASPECT:.0e} apart, '
                f'lengths below {MOST_LENGTH:.0e} and above {1 / MOST_LENGTH:.0e}, densities below {MOST_DENSITY:.0e}'
            )
        if worst == 1:
            first = _first(thin)
            warnings.warn(
                AccuracyWarning(
                    f'the scales of Gaussian {first} of {where} are more than {SAFE_ASPECT:.0e} '
                    'apart: its image may be off by 1e-4 and its derivatives by 1e-3'
                ),
                stacklevel=3,
            )
    return worst == 0


def require_unfrozen(what: str) -> None:
    """Raises InputError within a function under `dr.freeze`.

    A projection of a cloud shares its work out by counts that it reads back from the device, and these change with the cloud: a
    recording cannot be replayed, and Dr.Jit ends the process if one is tried. An operator of voxels reads back whether its
    argument is finite.

    Parameters
    ----------
    what : str
        Name of the called function, for the message.
    """
    if dr.flag(dr.JitFlag.FreezingScope):
        raise InputError(
            f'{what} cannot be recorded by dr.freeze, since it reads numbers back from the device: call it outside the frozen '
            'function'
        )


def _first(where: Any) -> int:
    """The first index at which a Bool is true."""
    index: Any = dr.compress(where)
    return int(index[0])
