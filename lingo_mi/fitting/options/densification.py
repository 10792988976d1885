"""Options of densification: when and how Gaussians are added and removed. `lingo_mi.fitting.densify` does the work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lingo_mi.fitting.options.part import MOST_STEPS, Part

_STEPS, _SIZES = (0, MOST_STEPS), (0, 1e6)


@dataclass(frozen=True)
class Densify(Part):
    """Adaptive density control. Lengths are in the normalised frame. Defaults are R2-Gaussian's.

    Parameters
    ----------
    densify_from, densify_until, densify_every : int
        Iterations.
    densify_threshold : float
        Mean gradient of the projected centre, in normalised device units, from which a Gaussian is doubled.
    prune_density : float
        Gaussians of lower density are removed, and those outside the volume.
    max_gaussians : int
        Largest number of Gaussians that densification makes.
    values_per_gaussian : float
        Least number of measured values for each Gaussian, at the start and later, since a small scan cannot determine many;
        0: no limit.
    """

    RANGES: ClassVar = dict(
        densify_from=_STEPS,
        densify_until=_STEPS,
        densify_every=(1, MOST_STEPS),
        densify_threshold=_SIZES,
        prune_density=_SIZES,
        max_gaussians=(1, 1e9),
        values_per_gaussian=(0, 1e9),
    )

    densify_from: int = 500
    densify_until: int = 15_000
    densify_every: int = 100
    densify_threshold: float = 5e-5
    prune_density: float = 1e-5
    max_gaussians: int = 500_000
    values_per_gaussian: float = 0.0

    reset_every: ClassVar[int] = 0

    def largest(self, iteration: int) -> float:
        """The standard deviation from which Gaussians are removed at an iteration."""
        return np.inf


@dataclass(frozen=True)
class Clone(Densify):
    """Small Gaussians are cloned, large ones split in two (R2-Gaussian).

    Parameters
    ----------
    split_size : float
        Gaussians with a larger standard deviation are split (R2-Gaussian: 0.1 of the longest side, which is 2).

    Examples
    --------
    `lm.R2().changed(densify_threshold=1e-4)`
    """

    RANGES: ClassVar = Densify.RANGES | dict(split_size=_SIZES)
    name: ClassVar = 'clone'

    split_size: float = 0.2


@dataclass(frozen=True)
class Halve(Densify):
    """Gaussians are cut in two along their longest axis, which keeps mass and covariance.

    Examples
    --------
    `lm.R2(densify=lm.Halve())`
    """

    name: ClassVar = 'halve'


@dataclass(frozen=True)
class CloneOpacities(Clone):
    """3DGS's rules for Gaussians with opacities; lengths are in units of the scene's radius. Defaults are 3DGS's.

    Clones keep the opacity, and Gaussians outside the volume stay.

    Parameters
    ----------
    prune_density : float
        Gaussians of lower opacity are removed.
    reset_every : int
        Iterations between resets of the opacities to 0.01, during densification; 0: never.
    prune_size : float
        Gaussians with a larger standard deviation are removed after the first reset.

    Examples
    --------
    `lm.GaussianSplatting().changed(reset_every=0)`
    """

    RANGES: ClassVar = Clone.RANGES | dict(reset_every=_STEPS, prune_size=_SIZES)
    name: ClassVar = 'opacities'

    densify_threshold: float = 2.5e-4  # 2e-4 for 3DGS's loss 0.8 L1 + 0.2 (1 - SSIM), which is 0.8 times the one here
    split_size: float = 0.01
    prune_density: float = 5e-3
    reset_every: int = 3000  # type: ignore[assignment] - a number of the class for those without opacities
    prune_size: float = 0.1

    def largest(self, iteration: int) -> float:
        return self.prune_size if 0 < self.reset_every < iteration else np.inf
