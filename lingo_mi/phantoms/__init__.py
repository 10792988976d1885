"""Computed test objects: no files, no download, no Mitsuba.

    from lingo_mi import phantoms
    phantoms.names()                        # ('chest', 'foot', 'gaussians', 'mesh', 'shepp_logan')
    foot = phantoms.make('foot', 128)
    foot.data, foot.spacing                 # float32 [x, y, z] in [0, 1], (2.0, 2.0, 2.0) mm

Every phantom is a cube centred on the origin of the world frame. The seed determines textures, vessels and
random clouds.
"""

from __future__ import annotations

import importlib
import operator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from lingo_mi.common import notebook
from lingo_mi.common.arrays import short_repr
from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import Geometry, Grid

# Attenuation per mm of a density of 1, if it is real: 2000 HU, dense cortical bone, with water of 0.0206 per mm at 60 keV (NIST,
# X-ray mass attenuation coefficients). R2-Gaussian's rule maps Hounsfield units to [0, 1] with the same upper end.
DENSEST = 3 * 0.0206
ATTENUATIONS = 'x3d', 'real'
_NAMES = ('chest', 'foot', 'gaussians', 'mesh', 'shepp_logan')


class Analytic(Protocol):
    """An object with exact line integrals."""

    def project(self, geometry: Geometry) -> np.ndarray:
        """Exact line integrals, float32 [view, v, u], density times mm."""
        ...


@dataclass(frozen=True)
class Scaled:
    """An analytic object with all densities times a factor."""

    analytic: Analytic
    factor: float

    def project(self, geometry: Geometry) -> np.ndarray:
        """Project like `Analytic.project`."""
        return self.analytic.project(geometry) * np.float32(self.factor)


@dataclass(frozen=True, eq=False)
class Phantom:
    """A voxelized test object.

    Parameters
    ----------
    data : ndarray
        float32 [x, y, z] in [0, 1], voxel averages or centre values, see the phantom's module.
    spacing : tuple[float, float, float]
        Voxel size, mm, (x, y, z).
    name : str
        Its name in the registry.
    analytic : Analytic or None
        The same object with exact projections; None if there is no closed form.
    """

    data: np.ndarray
    spacing: tuple[float, float, float]
    name: str
    analytic: Analytic | None = field(default=None, repr=False)

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        """For a notebook: slices, each with a slider."""
        return notebook.box(repr(self), notebook.slices(self.data, self.spacing, unit=''))

    def scaled(self, factor: float) -> Phantom:
        """The same object with all densities times a factor."""
        analytic = self.analytic and Scaled(self.analytic, factor)
        return Phantom(self.data * np.float32(factor), self.spacing, self.name, analytic)

    @property
    def grid(self) -> Grid:
        """Its voxels."""
        return Grid(self.data.shape, self.spacing)


def names() -> tuple[str, ...]:
    """Names of the phantoms for `make`, sorted."""
    return _NAMES


def require_name(name: str) -> None:
    """Raises InputError unless there is a phantom of this name."""
    if name not in _NAMES:
        raise InputError(f'there is no phantom {name!r}: choose one of {", ".join(_NAMES)}')


def make(name: str, size: int, seed: int = 0, attenuation: str = 'x3d') -> Phantom:
    """The phantom `name` on size^3 voxels.

    Parameters
    ----------
    seed : int
        Non-negative integer; ignored by phantoms without randomness (mesh, shepp_logan).
    attenuation : {'x3d', 'real'}
        Densities in [0, 1], X3D's convention; or these times `DENSEST`, per mm.

    Raises
    ------
    InputError
        For an unknown name or attenuation, a size outside 8..512 or a negative seed.
    """
    require_name(name)
    if attenuation not in ATTENUATIONS:
        raise InputError(f"attenuation must be 'x3d' or 'real', not {shown(attenuation)}")
    try:
        size, seed = operator.index(size), operator.index(seed)
    except TypeError:
        raise InputError(f'size and seed must be whole numbers, not {size!r} and {seed!r}') from None
    if not 8 <= size <= 512:
        raise InputError(f'the phantom size must be 8 to 512 voxels a side, not {size}')
    if seed < 0:
        raise InputError(f'the seed must not be negative, not {seed}')
    module = importlib.import_module(f'.{name}', __name__)
    data, side, analytic = module.build(size, seed)
    phantom = Phantom(data, (side / size,) * 3, name, analytic)
    return phantom if attenuation == 'x3d' else phantom.scaled(DENSEST)
