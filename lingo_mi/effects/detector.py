r"""A flat panel: from the intensity that reaches it to its signal, and back to line integrals (NumPy; the blur in Dr.Jit).

For a pixel with transmission T, gain g and open-beam counts I0:

    N = Poisson(I0 g T) + Normal(0, s_e)          counts (Barrett and Myers, "Foundations of Image Science", 2004, ch. 11)
    S = round(min(N / I0, top) / step) step       signal, step = top / (2^bits - 1)
    p = -ln(max(S / g, floor))                    line integral

The floor is half of the smallest nonzero signal (half a count or half a step), so that p is always finite. The noise of an
energy-integrating panel is slightly larger than the noise of equally many photons of one energy (its Swank factor is about 0.9).
Therefore `photons` is the number of noise-equivalent quanta.

Random numbers are from Philox4x64 (Salmon et al., SC 2011), a counter-based generator, keyed by seed and view. So the noise of
a view does not depend on which other views are rendered, or in which order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import convolve

from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import MOST_SEED
from lingo_mi.effects.focal_spot import checked_order
from lingo_mi.projectors.view import View

RESPONSES = 'energy', 'count'
MOST_PHOTONS = 1e15
MOST_COUNTS = 1e18  # in a pixel, that numpy can draw
FULL_SCALE = 1.25  # full scale of the converter without a saturation: above the open beam with its noise
DARKEST = 1e-30  # least transmission without noise; float32 holds 1e-38
_MAPS = 2**63  # added to a seed, so that gain and dead-pixel maps are independent of the noise


@dataclass(frozen=True)
class Detector:
    """Parameters of the film `ct_detector`; see there."""

    DEFAULTS: ClassVar = dict(
        photons=0.0,
        electronic_noise=0.0,
        response='energy',
        psf=0.0,
        aperture=0.0,
        aperture_order=3,
        saturation=0.0,
        bits=0,
        dead=0.0,
        gain=0.0,
        seed=0,
        corrected=True,
    )

    photons: float = 0.0
    electronic_noise: float = 0.0
    response: str = 'energy'
    psf: float = 0.0
    aperture: float = 0.0
    aperture_order: int = 3
    saturation: float = 0.0
    bits: int = 0
    dead: float = 0.0
    gain: float = 0.0
    seed: int = 0
    corrected: bool = True

    @staticmethod
    def of(**parameters: Any) -> Detector:
        """Checked parameters. Raises InputError."""
        ranges = dict(
            photons=MOST_PHOTONS,
            electronic_noise=MOST_PHOTONS,
            psf=1e6,
            aperture=1.0,
            saturation=1e6,
            dead=1.0,
            gain=1.0,
        )
        for name, most in ranges.items():
            value = parameters[name]
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= most:
                raise InputError(f'{name} must be a number from 0 to {most:g}, not {value!r}')
        for name, most in dict(bits=24, seed=MOST_SEED).items():
            value = parameters[name]
            if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
                raise InputError(f'{name} must be a whole number from 0 to {most}, not {value!r}')
        if parameters['response'] not in RESPONSES:
            raise InputError(f"response must be 'energy' or 'count', not {parameters['response']!r}")
        if not isinstance(parameters['corrected'], bool):
            raise InputError(f'corrected must be true or false, not {parameters["corrected"]!r}')
        if parameters['electronic_noise'] and not parameters['photons']:
            raise InputError('electronic_noise, in photons, needs photons')
        checked_order(parameters['aperture_order'], 'aperture_order')
        return Detector(**parameters)

    @property
    def measures(self) -> bool:
        """True if the electronics change the signal: noise, gains, saturation, digits or dead pixels."""
        return any((self.photons, self.saturation, self.bits, self.dead, self.gain))

    @property
    def expected(self) -> Detector:
        """The same detector without noise, bits and dead pixels. Blur and saturation stay, and gains if they affect it."""
        gain = self.gain if self.saturation and self.corrected else 0.0  # corrected gains still move the saturation
        return replace(self, photons=0.0, electronic_noise=0.0, bits=0, dead=0.0, gain=gain, corrected=True)

    def binned(self, pixels: int) -> Detector:
        """The detector after binning by that many pixels: their photons and noise, without dead pixels and gains."""
        noise = self.electronic_noise * pixels**0.5
        bits = self.bits and self.bits + round(math.log2(pixels**0.5))  # a mean of n is rounded sqrt(n) times as finely
        return replace(self, photons=self.photons * pixels, electronic_noise=noise, bits=bits, dead=0.0, gain=0.0)

    @property
    def floor(self) -> float:
        """The smallest transmission that differs from zero in the signal."""
        return max(0.5 / self.photons if self.photons else DARKEST, 0.5 * self._step)

    @property
    def _top(self) -> float:
        return self.saturation or FULL_SCALE

    @property
    def _step(self) -> float:
        return self._top / (2**self.bits - 1) if self.bits else 0.0

    def signal(self, transmission: ArrayLike, view: int, seed: int = 0) -> np.ndarray:
        """The signal of a view, in units of the open beam's, float64 [v, u], without correction of gains and dead pixels.

        Parameters
        ----------
        transmission : array_like
            Expected I / I0, [v, u], finite and not negative.
        view, seed : int
            Key of the noise, whole numbers from 0.
        """
        light = np.asarray(transmission, float)
        gains, dead = self.maps(light.shape)
        light = light * gains
        if self.photons:
            rng = np.random.Generator(np.random.Philox(key=[seed, view]))
            if not (self.photons * light).max(initial=0) < MOST_COUNTS:
                raise InputError('a view is brighter than can be counted: negative densities, or too many photons')
            light = rng.poisson(self.photons * light) / self.photons
            if self.electronic_noise:
                light = light + rng.normal(0, self.electronic_noise / self.photons, light.shape)
        if self.saturation or self.bits:
            light = np.minimum(light, self._top)
        if self.bits:
            light = np.round(np.maximum(light, 0) / self._step) * self._step
        return np.where(dead, 0, light)

    def measure(self, transmission: ArrayLike, view: int, seed: int = 0) -> np.ndarray:
        """Line integrals -ln(I / I0) as a scanner reports them, float32 [v, u], finite. Arguments as for `signal`."""
        light = self.signal(transmission, view, seed)
        if self.corrected:
            gains, dead = self.maps(light.shape)
            light = filled(light / gains, dead)
        return -np.log(np.maximum(light, self.floor)).astype(np.float32)

    def least(self, shape: tuple[int, int]) -> np.ndarray:
        """The smallest line integrals that the detector can report, of saturated pixels, float64 [v, u]."""
        return self.saturates(shape) if self.corrected else np.full(shape, -np.log(self.saturation))

    def saturates(self, shape: tuple[int, int]) -> np.ndarray:
        """The true line integrals at which pixels saturate, float64 [v, u]: brighter ones of a larger gain do sooner."""
        return -np.log(self.saturation / self.maps(shape)[0])

    def deviation(self, transmission: ArrayLike) -> np.ndarray:
        """Standard deviation of a line integral -ln(N / I0) from counting noise and rounding to `bits`, to first order.

        Parameters
        ----------
        transmission : array_like
            Any shape; values below the floor count as the floor.
        """
        light = np.maximum(transmission, self.floor)
        variance = self._step**2 / 12
        if self.photons:
            variance = variance + light / self.photons + (self.electronic_noise / self.photons) ** 2
        return np.sqrt(variance) / light

    def maps(self, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Gains, float64, and dead pixels, bool, [v, u]: the same for all views."""
        return _maps(self.seed, self.gain, self.dead, tuple(shape))

    def blurred(self, image: Any, view: View) -> Any:
        """The intensity, Float [height * width], blurred by the scintillator. Differentiable.

        The blur is a Gaussian sampled at the pixels, accurate for widths of at least one pixel. The panel's edge values
        continue outside.
        """
        import drjit as dr
        import mitsuba as mi

        image = mi.TensorXf(image, shape=(view.height, view.width))
        for axis, step in ((0, view.v), (1, view.u)):
            # Rounded, because the taps are compiled into the kernel: no two views may differ in their last digit.
            sigma = max(round(self.psf / FWHM / float(dr.detach(dr.norm(step))[0]), 6), 1e-6)
            image = dr.convolve(image, taps(sigma), axis=axis, boundary='nearest')
        return image.array

    def __str__(self):
        changed = [f'{k} = {getattr(self, k)}' for k, v in self.DEFAULTS.items() if getattr(self, k) != v]
        return ', '.join(changed) or 'ideal'


FWHM = 2 * np.sqrt(2 * np.log(2))  # of a Gaussian, in standard deviations


def taps(sigma: float) -> list[float]:
    """Weights of a Gaussian of `sigma` pixels at whole pixels, out to five sigma; they sum to 1."""
    reach = max(1, int(np.ceil(5 * sigma)))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (weights / weights.sum()).tolist()


@lru_cache(maxsize=4)
def _maps(seed, gain, dead, shape):
    key = np.array([_MAPS + seed, 0], np.uint64)  # a list would become float64, which rounds the seed off
    rng = np.random.Generator(np.random.Philox(key=key))
    gains = np.maximum(1 + gain * rng.standard_normal(shape), 0.01)  # no pixel is quite blind by its gain
    return gains, rng.random(shape) < dead


def filled(light, dead):
    """Dead pixels replaced by the mean of their live neighbours, from the edges of a cluster inwards."""
    light = np.where(dead, 0, light)
    if dead.all():
        return light
    around = np.array([[1, 2, 1], [2, 0, 2], [1, 2, 1]], float)
    while dead.any():
        live = convolve((~dead).astype(float), around, mode='constant')
        total = convolve(light, around, mode='constant')
        reached = dead & (live > 0)
        light = np.where(reached, total / np.maximum(live, 1), light)
        dead = dead & ~reached
    return light
