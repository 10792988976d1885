"""The start of R2-Gaussian, from an FDK volume (section 4.1 and its released settings)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.neighbours import neighbour_distance
from lingo_mi.fitting.start.number import NumberedStart
from lingo_mi.fitting.start.start import Render, StartingCloud
from lingo_mi.geometry.base import Geometry
from lingo_mi.lingo.voxel_filter import voxel_centres
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan


@dataclass(frozen=True)
class FDKStart(NumberedStart):
    """Random voxels of an FDK volume, without replacement. Points lie at voxel centres.

    Parameters
    ----------
    n_points : int
        Voxels drawn, or all voxels above the threshold if these are fewer.
    fdk_threshold : float
        Only voxels above it are drawn, in the fit's unit of density (R2-Gaussian: 0.05).
    fdk_rescale : float
        Density of a Gaussian over the density of its voxel (R2-Gaussian: 0.15).

    Examples
    --------
    `lm.LINGO(start=lm.FDKStart())`
    """

    RANGES: ClassVar = NumberedStart.RANGES | dict(fdk_threshold=(-1e6, 1e6), fdk_rescale=(0, 1e6))
    name: ClassVar = 'fdk'

    fdk_threshold: float = 0.05
    fdk_rescale: float = 0.15

    def count(self, geometry: Geometry) -> int:
        return min(self.n_points, math.prod(geometry.grid.shape))

    def cloud(self, scan: Scan, rng: np.random.Generator, render: Render, unit: float) -> StartingCloud:
        return self.from_volume(run_algorithm(scan, FDK()).volume / unit, scan.geometry.grid.half, rng, unit)

    def from_volume(
        self, volume: np.ndarray, half: np.ndarray, rng: np.random.Generator, unit: float = 1.0
    ) -> StartingCloud:
        """Draw the cloud from a volume.

        Parameters
        ----------
        volume : ndarray
            [x, y, z] in the fit's unit.
        half : [3]
            Half the volume's sides in the normalised frame.
        rng : Generator
            Generator of all random choices.
        unit : float
            The density that the fit counts as 1, in 1/mm.

        Returns
        -------
        StartingCloud
            In the normalised frame.

        Raises
        ------
        InputError
            If no voxel is above `fdk_threshold`.
        """
        cells = np.flatnonzero(volume > self.fdk_threshold)
        if len(cells) == 0:
            raise InputError(
                f'no voxel of the FDK volume is above {self.fdk_threshold:g} (the largest is {volume.max():g}): set a lower '
                'fdk_threshold, or normalise=true'
            )
        chosen = rng.permutation(cells)[: self.n_points]
        points = voxel_centres(volume.shape, half, chosen)
        size = 2 * np.asarray(half, float) / volume.shape
        density = self.fdk_rescale * volume.ravel()[chosen].astype(float)
        info = {'method': self.name, 'threshold': self.fdk_threshold, 'cells': len(cells)}
        return StartingCloud(points, density * unit, neighbour_distance(points, fallback=size.min()), info)
