"""The three kinds of hard cases: a cloud in a view, a cloud on voxels, something done with a scan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lingo_mi.geometry.rays import Rays
from lingo_mi.validation.oracle import Cloud

IMAGE, GRADIENT = 1e-6, 1e-5  # what a case may show unless it says otherwise


@dataclass(frozen=True)
class ViewCase:
    """A cloud in one view.

    Parameters
    ----------
    image, gradient : float
        Largest errors allowed.
    copies : int
        How often the cloud is there, at the same place.
    warned : bool
        Whether an AccuracyWarning must come with it.
    analytic : bool
        Whether derivatives are compared with `closed_form`, since differences of the oracle's float64 are too coarse;
        only for Gaussians far from the ends of the rays.
    note : str
        Reason for an accuracy below the usual one.
    """

    name: str
    cloud: Cloud
    rays: Rays
    shape: tuple[int, ...]
    image: float = IMAGE
    gradient: float = GRADIENT
    copies: int = 1
    warned: bool = False
    analytic: bool = False
    note: str = ''


@dataclass(frozen=True)
class VoxelCase:
    """A cloud on a grid of voxels. The errors are errors of the densities at the voxels' centres."""

    name: str
    cloud: Cloud
    corner: np.ndarray
    step: np.ndarray
    shape: tuple[int, ...]
    image: float = IMAGE
    gradient: float = GRADIENT
    warned: bool = False
    note: str = ''


@dataclass(frozen=True)
class ScanCase:
    """Something done with a scan or a scene: `act()` must be refused with words of `refused`, or end well.

    Parameters
    ----------
    warned : bool
        Whether an AccuracyWarning must come with it.
    """

    name: str
    act: Callable[[], object]
    refused: str = ''
    warned: bool = False
    note: str = ''
