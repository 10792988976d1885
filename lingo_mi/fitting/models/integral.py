"""Line integrals of Gaussian densities: the forward model of LINGO and of R2-Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from lingo_mi.fitting.activations import inverse_softplus, softplus
from lingo_mi.fitting.models.forward import SHAPE, ForwardModel
from lingo_mi.projectors.backprop import Cuts
from lingo_mi.projectors.footprint import Footprints, project
from lingo_mi.projectors.splat import splat
from lingo_mi.projectors.view import View

PARAMETERS = SHAPE | {'density': 1}


@dataclass(frozen=True)
class LineIntegrals(ForwardModel):
    """Densities by softplus (R2-Gaussian, section 4.1). Pixels are line integrals, exact up to the cut-off `extent`."""

    extent: float

    replayable: ClassVar = True

    @property
    def parameters(self) -> dict[str, int]:
        return PARAMETERS

    def initial(self, n: int, density: np.ndarray | None) -> dict[str, np.ndarray]:
        return {'density': inverse_softplus(np.asarray(density))[:, None]}

    def amount(self, values: dict[str, np.ndarray]) -> np.ndarray:
        return softplus(values['density'][:, 0].astype(float))

    def shared(self, values: dict[str, np.ndarray], chosen: np.ndarray, factor: float) -> dict[str, np.ndarray]:
        """The chosen densities are multiplied by `factor`."""
        raw = values['density'].astype(float)
        raw[chosen] = inverse_softplus(softplus(raw[chosen]) * factor)
        return values | {'density': raw.astype(np.float32)}

    def may_stay(self, centre: np.ndarray, scale: np.ndarray, half: np.ndarray, largest: float) -> np.ndarray:
        """Gaussians centred inside the volume."""
        return np.all(np.abs(centre) <= np.asarray(half), axis=1)

    def gaussians(self, values: dict) -> tuple:
        return *self._shape(values), _softplus(values['density'])

    def footprints(self, gaussians: tuple, rays: View, cut: Cuts | None = None) -> Footprints:
        return project(gaussians, rays, self.extent, cut=cut)

    def integrals(self, footprints: Footprints, rays: View, share: Any = None) -> list:
        amplitude, *others = footprints.values
        parts = [amplitude] if share is None else [amplitude * (1 - share), amplitude * share]
        return [
            splat(replace(footprints, values=(part, *others)), rays.height, rays.width, self.extent) * rays.lengths()
            for part in parts
        ]


def _softplus(x):
    """ln(1 + e^x) without overflow, with float32's relative precision at both ends."""
    above = x > 0  # maximum and abs would have derivatives at 0 that sum to 0
    small = dr.exp(dr.select(above, -x, x))
    series = small * (1 - small * (1 / 2 - small * (1 / 3 - small / 4)))  # 1 + small would round small away
    return dr.select(above, x, 0) + dr.select(small < 0.01, series, dr.log(1 + small))
