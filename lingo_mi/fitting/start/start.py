"""The interface of all starts, and the cloud that one makes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from lingo_mi.fitting.options.part import Part
from lingo_mi.geometry.base import Geometry
from lingo_mi.scan import Scan

# render(points, density, spacing, views): projections, normalised, [len(views), v, u] of isotropic Gaussians in these views.
Render = Callable[[np.ndarray, np.ndarray, np.ndarray, Any], np.ndarray]


@dataclass(frozen=True)
class StartingCloud:
    """The Gaussians that a fit starts from, in the normalised frame.

    Parameters
    ----------
    points : ndarray
        Centres, float64 [N, 3].
    density : ndarray or None
        Values at the centres, 1/mm, float64 [N]; None for Gaussians with opacities.
    spacing : ndarray
        Standard deviations, float64 [N].
    info : dict
        Measurements of the start: numbers and texts.
    """

    points: np.ndarray
    density: np.ndarray | None
    spacing: np.ndarray
    info: dict = field(default_factory=dict, compare=False)

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Start(Part, ABC):
    """Initial Gaussians of a fit.

    Attributes
    ----------
    densities : bool
        Whether the cloud has densities; without, only methods with opacities can start from it.
    """

    densities: ClassVar[bool] = True

    @abstractmethod
    def cloud(self, scan: Scan, rng: np.random.Generator, render: Render, unit: float) -> StartingCloud:
        """Make the initial Gaussians of a scan.

        Parameters
        ----------
        scan : Scan
            Line integrals.
        rng : Generator
            Generator of all random choices.
        render : callable
            Renders a cloud of isotropic Gaussians; see `Render`.
        unit : float
            The density that the fit counts as 1, in 1/mm.

        Returns
        -------
        StartingCloud
            In the normalised frame.

        Raises
        ------
        InputError
            If the scan gives no cloud.
        """

    def count(self, geometry: Geometry) -> int:
        """Return the largest number of Gaussians, so that memory is asked for before the work.

        Parameters
        ----------
        geometry : Geometry
            Geometry of the scan.

        Returns
        -------
        int
            0 if the start asks by itself.
        """
        return 0

    def limited(self, most: int) -> Start:
        """Return the same start with a limited number of Gaussians.

        Parameters
        ----------
        most : int
            Largest number of Gaussians.

        Returns
        -------
        Start
            A copy, or the same object if the number is not an option.
        """
        return self
