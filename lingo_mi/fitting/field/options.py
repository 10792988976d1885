"""The options of a neural field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.options.part import Part

FINEST = 2**21  # points along a side: float32's positions within its cells have 3 bits left


@dataclass(frozen=True)
class Field(Part):
    """Hash grid, network and samples of a neural field. Defaults are NAF's published values.

    Parameters
    ----------
    field_levels : int
        Levels of the hash grid (NAF: 16).
    field_features : int
        Features an entry, even (NAF: 2).
    field_entries : int
        Entries of a level, at most (NAF: 2^19); levels with fewer grid points are stored whole.
    field_base : int
        Grid points along a side of the coarsest level (NAF: 16).
    field_growth : float
        Ratio of the grid points of two successive levels (NAF: 2).
    field_cube : float
        Side of the cube that the grid covers, in units of the volume's longest side (NAF: 0.6 m, for volumes of 256 mm).
    field_layers : int
        Layers of the network (NAF: 4).
    field_width : int
        Outputs of all layers but the last (NAF: 32).
    field_skip : int
        The layer, from 0, that receives the features again (NAF: 2).
    field_start : {'mean', 'random'}
        'random' starts at about half the largest density everywhere (NAF), 'mean' at the scan's mean density. From half, a field
        of a small object falls to 0 first and takes a thousand steps to rise again.
    field_samples : int
        Samples on a ray (NAF: 192 for 128^3 voxels, 320 for 256^3).
    field_rays : int
        Rays of a view in a step (NAF: 1024).

    Examples
    --------
    `lm.NAF(field=lm.Field(field_levels=12))`
    """

    RANGES: ClassVar = dict(
        field_levels=(1, 32),
        field_features=(2, 16),
        field_entries=(16, 2**26),
        field_base=(2, 1024),
        field_growth=(1, 4),
        field_cube=(1, 100),
        field_layers=(2, 16),
        field_width=(1, 1024),
        field_skip=(1, 16),
        field_samples=(1, 1e5),
        field_rays=(1, 1e6),
    )
    CHOICES: ClassVar = dict(field_start=('mean', 'random'))

    field_levels: int = 16
    field_features: int = 2
    field_entries: int = 2**19
    field_base: int = 16
    field_growth: float = 2.0
    field_cube: float = 2.34375
    field_layers: int = 4
    field_width: int = 32
    field_skip: int = 2
    field_start: str = 'mean'
    field_samples: int = 192
    field_rays: int = 1024

    def __post_init__(self):
        super().__post_init__()
        if self.field_features % 2:
            raise InputError(f'field_features is even, not {self.field_features}')
        if self.field_skip >= self.field_layers:
            raise InputError(
                f'field_skip is a layer after the first: from 1 to {self.field_layers - 1}, not {self.field_skip}'
            )
        finest = self.field_base * self.field_growth ** (self.field_levels - 1)
        if finest > FINEST:
            raise InputError(
                f'the finest level of the hash grid has {finest:.3g} points along a side, more than float32 can tell apart '
                f'({FINEST}): lower field_levels or field_growth'
            )
