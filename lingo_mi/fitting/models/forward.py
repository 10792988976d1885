"""The interface between a forward model and a fit of its parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting.options.bounds import ScaleBounds
from lingo_mi.projectors.alpha import Discs
from lingo_mi.projectors.backprop import Cuts
from lingo_mi.projectors.footprint import Footprints
from lingo_mi.projectors.view import View

SHAPE = {'centre': 3, 'scale': 3, 'rotation': 4}  # raw parameters of the shape, in all forward models


@dataclass(frozen=True)
class ForwardModel(ABC):
    """Gaussians with raw parameters, and their image.

    Values on the host are NumPy arrays [N, size] by parameter, on the device Dr.Jit arrays of N.

    Attributes
    ----------
    bounds : ScaleBounds
        Bounds of the standard deviations.
    replayable
        Whether a view's loss and derivatives can be replayed (`projectors.replay`).
    """

    bounds: ScaleBounds

    replayable: ClassVar[bool]

    @property
    @abstractmethod
    def parameters(self) -> dict[str, int]:
        """Sizes of a Gaussian's raw parameters, by name: `SHAPE` and the model's own."""

    # ---- on the host ----

    @abstractmethod
    def initial(self, n: int, density: np.ndarray | None) -> dict[str, np.ndarray]:
        """The model's own raw parameters at the start of a fit with n Gaussians, float [n, size].

        Parameters
        ----------
        density : ndarray or None
            Values at the centres, in the fit's unit, [n]; None if the initial cloud has no densities.
        """

    @abstractmethod
    def amount(self, values: dict[str, np.ndarray]) -> np.ndarray:
        """Densities, in the fit's unit, or opacities, float64 [N]."""

    @abstractmethod
    def shared(self, values: dict[str, np.ndarray], chosen: np.ndarray, factor: float) -> dict[str, np.ndarray]:
        """The values after each chosen Gaussian [N] has been prepared for duplication: its density is multiplied by `factor`.

        Opacities stay.
        """

    @abstractmethod
    def may_stay(self, centre: np.ndarray, scale: np.ndarray, half: np.ndarray, largest: float) -> np.ndarray:
        """Return the mask of the Gaussians that may stay, bool [N].

        Parameters
        ----------
        centre, scale : ndarray [N, 3]
        half : ndarray
            Half the volume's sides, [3].
        largest : float
            Upper bound of the standard deviations, if the model has one.
        """

    # ---- on the device ----

    @abstractmethod
    def gaussians(self, values: dict) -> tuple:
        """Centres, standard deviations, quaternions (not normalised), densities or opacities, and further arguments of
        `footprints`. Differentiable."""

    @abstractmethod
    def footprints(self, gaussians: tuple, rays: View, cut: Cuts | None = None) -> Footprints | Discs:
        """Footprints of a cloud on a view's panel. The last two `values` are x and y in pixels. Differentiable.

        Parameters
        ----------
        cut : Cuts or None
            Cuts at which `pass_on` backpropagates in parts, if the model can.
        """

    @abstractmethod
    def integrals(self, footprints: Any, rays: View, share: Any = None) -> list:
        """Line integrals along the rays of a view: a list of Float [height * width], one for each material. Differentiable.

        Parameters
        ----------
        share
            Share of the second of two materials in every Gaussian, Float [N]; None: one material.
        """

    def hold_back(self, gradients: dict, iteration: int) -> None:  # noqa: B027 - most models hold nothing back
        """Set the gradients of parameters to zero that are not fitted yet at this iteration."""

    def _shape(self, values: dict):
        """Centres, standard deviations by a sigmoid between the bounds (R2-Gaussian), and quaternions, on the device."""
        low = dr.opaque(mi.Float, self.bounds.scale_min)
        high = dr.opaque(mi.Float, self.bounds.scale_max - self.bounds.scale_min)
        return values['centre'], low + high / (1 + dr.exp(-values['scale'])), values['rotation']
