"""Grey images composited front to back from opacities and radiances: the forward model of 3DGS and of X-Gaussian.

It has no densities and no volume. The grey images are the projections divided by their maximum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting.activations import inverse_sigmoid, sigmoid
from lingo_mi.fitting.models.forward import SHAPE, ForwardModel
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.alpha import Discs, composite, flatten
from lingo_mi.projectors.backprop import Cuts
from lingo_mi.projectors.radiance import radiance_towards
from lingo_mi.projectors.view import View

OPACITY = 0.1  # of all Gaussians at the start of a fit (3DGS)


@dataclass(frozen=True)
class AlphaCompositing(ForwardModel):
    """Opacities by a sigmoid (3DGS), radiances as in `projectors.radiance`. Clones and halves keep both.

    Raw parameters besides the shape: 'opacity', 'radiance' and 'harmonics', the coefficients of the radiance's spherical
    harmonics from degree 1 on, degree by degree.

    Parameters
    ----------
    sh_degree, sh_every : int
        As for `GaussianSplatting`.
    """

    sh_degree: int
    sh_every: int

    replayable: ClassVar = False

    @property
    def parameters(self) -> dict[str, int]:
        harmonics = {'harmonics': (self.sh_degree + 1) ** 2 - 1} if self.sh_degree else {}
        return SHAPE | {'opacity': 1, 'radiance': 1} | harmonics

    def initial(self, n: int, density: np.ndarray | None) -> dict[str, np.ndarray]:
        """Opacity 0.1 and half grey for all Gaussians (3DGS). The density is not used."""
        appearance = {k: np.zeros((n, size)) for k, size in self.parameters.items() if k not in SHAPE}
        return appearance | {'opacity': np.full((n, 1), inverse_sigmoid(OPACITY))}

    def amount(self, values: dict[str, np.ndarray]) -> np.ndarray:
        return sigmoid(values['opacity'][:, 0].astype(float))

    def shared(self, values: dict[str, np.ndarray], chosen: np.ndarray, factor: float) -> dict[str, np.ndarray]:
        """Unchanged: duplicates keep the opacity."""
        return values

    def may_stay(self, centre: np.ndarray, scale: np.ndarray, half: np.ndarray, largest: float) -> np.ndarray:
        """Gaussians that are not too large, inside the volume or not (3DGS)."""
        return scale.max(1) <= largest

    def gaussians(self, values: dict) -> tuple:
        """Return the Gaussians as in `ForwardModel`, and then the arguments of `projectors.radiance.radiance_towards`."""
        radiance = [values[k] for k in ('radiance', 'harmonics') if k in values]
        return *self._shape(values), 1 / (1 + dr.exp(-values['opacity'])), *radiance

    def footprints(self, gaussians: tuple, rays: View, cut: Cuts | None = None) -> Discs:
        centre, scale, rotation, opacity, *radiance = gaussians
        return flatten(centre, scale, rotation, opacity, radiance_towards(centre, rays, *radiance), rays)

    def integrals(self, footprints: Discs, rays: View, share: Any = None) -> list:
        """The grey image, in place of line integrals."""
        return [composite(footprints, rays.height, rays.width)]

    def hold_back(self, gradients: dict, iteration: int) -> None:
        """Harmonics of degrees that have not started stay zero (3DGS)."""
        if 'harmonics' not in gradients:
            return
        degrees = range(1, self.sh_degree + 1)
        joined = [dr.opaque(mi.Float, float((iteration + 1) // self.sh_every >= k)) for k in degrees]
        for i in range(len(gradients['harmonics'])):
            gradients['harmonics'][i] *= joined[math.isqrt(i + 1) - 1]


def harmonics(values: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the radiance's spherical harmonics: degree 0 [N], and higher degrees [N, M].

    The radiance is 1/2 plus their sum. If it is the same in all directions, it is a sigmoid of the raw value (see
    `projectors.radiance`), here converted to degree 0.
    """
    raw = values['radiance'][:, 0].astype(float)
    if 'harmonics' in values:
        return raw, values['harmonics']
    return np.sqrt(4 * np.pi) * (sigmoid(raw) - 0.5), np.zeros((len(raw), 0))


def scene_radius(geometry: Geometry) -> float:
    """3DGS's unit of length: 1.1 times the largest distance of a source from the mean of all, in the normalised frame.

    1 for a single view and for a parallel beam, where that distance does not exist.
    """
    rays = geometry.normalised_rays()
    if rays.parallel:
        return 1.0
    return 1.1 * float(np.linalg.norm(rays.source - rays.source.mean(0), axis=1).max()) or 1.0
