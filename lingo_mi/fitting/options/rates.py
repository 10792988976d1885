"""Adam's step sizes and moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lingo_mi.fitting.options.part import MOST_STEPS, Part

RATES = (1e-12, 1e3)
DECAY = (0, 1 - 1e-6)  # float32 rounds more to 1


@dataclass(frozen=True)
class Rates(Part):
    """Adam's moments, the fall of the rates, and the mean of the last steps.

    A kind adds `rate_NAME`, (first, last), for each parameter of its Gaussians or its field. Rates fall log-linearly.

    Parameters
    ----------
    decay_steps : int
        Iterations over which the rates fall from first to last; 0: all iterations of the fit.
    beta1, beta2 : float
        Decay of the moments (R2-Gaussian: Adam's usual 0.9 and 0.999).
    nesterov : bool
        Whether a step goes in the direction of the first moment after the next one (Dozat, "Incorporating Nesterov momentum into
        Adam", 2016).
    epsilon : float
        Added to the root of the second moment (R2-Gaussian: 1e-15).
    average : float
        Decay of the running mean of the parameters, which is the result; 0: the parameters of the last step are.
    """

    RANGES: ClassVar = dict(decay_steps=(0, MOST_STEPS), beta1=DECAY, beta2=DECAY, epsilon=(1e-30, 1), average=DECAY)

    decay_steps: int = 30_000
    beta1: float = 0.9
    beta2: float = 0.999
    nesterov: bool = False
    epsilon: float = 1e-15
    average: float = 0.0


@dataclass(frozen=True)
class DensityRates(Rates):
    """Rates of Gaussians with densities; lengths are in the normalised frame. Defaults are R2-Gaussian's.

    Parameters
    ----------
    decay_steps, beta1, beta2, nesterov, epsilon, average
        See `Rates`.
    rate_centre, rate_scale : tuple of float
        Step sizes (first, last) for the centres and the standard deviations.
    rate_density : tuple of float
        Step sizes for the densities.
    rate_rotation : tuple of float
        Step sizes for the quaternions.

    Examples
    --------
    `lm.Fast().changed(rate_centre=(1e-3, 1e-4))`
    """

    RANGES: ClassVar = Rates.RANGES | dict.fromkeys(
        ('rate_centre', 'rate_density', 'rate_scale', 'rate_rotation'), RATES
    )

    rate_centre: tuple[float, float] = (2e-4, 2e-5)
    rate_density: tuple[float, float] = (1e-2, 1e-3)
    rate_scale: tuple[float, float] = (5e-3, 5e-4)
    rate_rotation: tuple[float, float] = (1e-3, 1e-4)


@dataclass(frozen=True)
class OpacityRates(Rates):
    """Rates of Gaussians with opacities and radiances; `rate_centre` is in units of the scene's radius (see `models.alpha`).

    Defaults are 3DGS's.

    Parameters
    ----------
    decay_steps, beta1, beta2, nesterov, epsilon, average
        See `Rates`.
    rate_centre, rate_scale, rate_rotation : tuple of float
        Step sizes (first, last) for the centres, the standard deviations and the quaternions.
    rate_opacity : tuple of float
        Step sizes for the opacities.
    rate_radiance, rate_harmonics : tuple of float
        Step sizes for the mean radiance and for its spherical harmonics.

    Examples
    --------
    `lm.GaussianSplatting().changed(rate_opacity=(2e-2, 2e-2))`
    """

    RANGES: ClassVar = Rates.RANGES | dict.fromkeys(
        ('rate_centre', 'rate_scale', 'rate_rotation', 'rate_opacity', 'rate_radiance', 'rate_harmonics'), RATES
    )

    rate_centre: tuple[float, float] = (1.6e-4, 1.6e-6)
    rate_scale: tuple[float, float] = (5e-3, 5e-3)
    rate_rotation: tuple[float, float] = (1e-3, 1e-3)
    rate_opacity: tuple[float, float] = (5e-2, 5e-2)
    rate_radiance: tuple[float, float] = (2.5e-3, 2.5e-3)
    rate_harmonics: tuple[float, float] = (1.25e-4, 1.25e-4)


@dataclass(frozen=True)
class FieldRates(Rates):
    """Rates of a neural field. NAF's are 0.001, later 0.0001.

    Parameters
    ----------
    decay_steps, beta1, beta2, nesterov, epsilon, average
        See `Rates`.
    rate_features, rate_network : tuple of float
        Step sizes (first, last) for the features of the hash grid and for the weights of the network.

    Examples
    --------
    `lm.NAF().changed(rate_network=(5e-4, 5e-5))`
    """

    RANGES: ClassVar = Rates.RANGES | dict.fromkeys(('rate_features', 'rate_network'), RATES)

    rate_features: tuple[float, float] = (1e-3, 1e-4)
    rate_network: tuple[float, float] = (1e-3, 1e-4)


def between(pair: tuple[float, float], share: float) -> float:
    """The rate after a share of the fall, from 0 to 1: log-linear between the first and the last."""
    first, last = pair
    return first ** (1 - share) * last**share
