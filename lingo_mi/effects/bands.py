r"""A spectrum in a few energy bands: beam hardening as a short sum of exponentials, and its inverse (NumPy).

A beam passes M materials with line integrals p_m at a reference energy E0. Let s(E) be the detected spectrum and
r_m(E) = mu_m(E) / mu_m(E0). A detector measures (Alvarez and Macovski, Phys. Med. Biol. 21, 1976, eq. 4)

    h(p) = -ln \int s(E) exp(-sum_m r_m(E) p_m) dE   ~   -ln sum_k w_k exp(-sum_m R_mk p_m)

with K terms of positive weights that sum to 1. The terms start as K intervals of energy. Weights and ratios are then
optimised together for the least mean square error of h up to a largest h of every material alone, so the result does not
depend on the reference energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, least_squares
from scipy.special import logsumexp, softmax
from scipy.stats import qmc

from lingo_mi.common.errors import InputError

MOST_BANDS = 6
MOST_STEPS = 1000  # of the search; the remaining error is `Bands.error`


@dataclass(frozen=True)
class Bands:
    """A spectrum for a given choice of materials.

    Parameters
    ----------
    weights : ndarray
        [K] shares of the signal; they sum to 1.
    ratios : ndarray
        [M, K] attenuation relative to that at the reference energy.
    error : float
        Largest error of h, against the full spectrum, over the range that the bands are for.
    """

    weights: np.ndarray
    ratios: np.ndarray
    error: float = 0.0

    def hardened(self, *integrals: ArrayLike) -> np.ndarray:
        """h, float64: the measured signal for line integrals at the reference energy, M arrays of one shape."""
        return _hardened(np.stack([np.asarray(p, float) for p in integrals], -1), self.weights, self.ratios)

    def precorrected(self, measured: ArrayLike) -> np.ndarray:
        """The inverse of h: line integrals at the reference energy from `measured`, float64 (water precorrection, M = 1).

        h rises and is concave, so Newton's method converges from any start.

        Parameters
        ----------
        measured : array_like
            An array of any shape; h is continued linearly to negative values, which occur with noise.
        """
        if len(self.ratios) != 1:
            raise InputError(f'precorrection is for one material, not {len(self.ratios)}')
        target, ratios = np.asarray(measured, float), self.ratios[0]
        slope = self.weights @ ratios
        p = target / slope
        for _ in range(100):
            exponent = np.log(self.weights) - np.maximum(p, 0)[..., None] * ratios
            share = softmax(exponent, -1)
            total: Any = logsumexp(exponent, axis=-1)
            value = -total + slope * np.minimum(p, 0)
            step = (target - value) / (share @ ratios)
            p = p + step
            if not np.any(np.abs(step) > 1e-12 * (1 + np.abs(p))):
                break
        return p


def band(signal: ArrayLike, ratios: ArrayLike, count: int, largest: float) -> Bands:
    """The `count` bands that fit a spectrum best.

    Parameters
    ----------
    signal : array_like
        [E] shares of the detected signal; they sum to 1.
    ratios : array_like
        [M, E] attenuation of every material, relative to that at the reference energy.
    count : int
        Bands, 1 to 6.
    largest : float
        h up to which they are fitted: of each material alone, and of mixtures of such amounts.

    Raises
    ------
    InputError
        For a count out of range.
    """
    if not 1 <= count <= MOST_BANDS:
        raise InputError(f'bands must be from 1 to {MOST_BANDS}, not {count}')
    signal, ratios = np.asarray(signal, float), np.asarray(ratios, float)
    used = signal > 0
    return _band(signal[used].tobytes(), ratios[:, used].tobytes(), len(ratios), count, float(largest))


@lru_cache(maxsize=16)
def _band(signal, ratios, materials, count, largest):
    signal = np.frombuffer(signal)
    ratios = np.frombuffer(ratios).reshape(materials, -1)
    if len(signal) <= count:
        return Bands(signal, ratios)
    reach = np.array([_reach(signal, r, largest) for r in ratios])
    points = _points(materials, 7) * reach
    exact = _hardened(points, signal, ratios)
    # Narrow bands at low energies: few photons, but they cause the hardening.
    edges = np.searchsorted(np.cumsum(signal), (np.arange(1, count) / count) ** 2.5)
    parts = [i for i in np.split(np.arange(len(signal)), edges) if len(i)]
    count = len(parts)
    weights = np.array([signal[i].sum() for i in parts])
    start = np.stack([ratios[:, i] @ signal[i] for i in parts], 1) / weights

    def unpacked(x):
        return softmax(x[:count]), np.exp(x[count:]).reshape(materials, count)

    def error(x):
        return _hardened(points, *unpacked(x)) - exact

    def jacobian(x):
        w, r = unpacked(x)
        share = softmax(np.log(w) - points @ r, -1)
        return np.concatenate([w - share] + [share * points[:, m, None] * r[m] for m in range(materials)], 1)

    x = least_squares(
        error,
        np.concatenate([np.log(weights), np.log(start).ravel()]),
        jac=jacobian,  # pyright: ignore[reportArgumentType] - a function too, which SciPy's declaration leaves out
        xtol=1e-10,
        ftol=1e-10,
        gtol=1e-14,
        max_nfev=MOST_STEPS,
    ).x
    weights, energies = unpacked(x)
    fine = _points(materials, 11) * reach
    worst = np.abs(_hardened(fine, weights, energies) - _hardened(fine, signal, ratios)).max()
    return Bands(weights, energies, float(worst))


def _hardened(points, weights, ratios):
    """h at points [..., M]."""
    total: Any = logsumexp(-points @ ratios, b=weights, axis=-1)
    return -total


def _reach(signal, ratios, largest):
    """The line integral of one material that is measured as `largest`."""
    most = largest / ratios.min()  # h rises at least as fast as in the hardest light
    return brentq(lambda p: _hardened(np.array([p]), signal, ratios[None]) - largest, 0, most * (1 + 1e-6))


def _points(materials, power):
    """Amounts [n, M] with sums up to 1: each material alone, and 2^power mixtures."""
    n = 2**power
    alone = np.concatenate([np.linspace(0, 1, n)[:, None] * axis for axis in np.eye(materials)])
    if materials == 1:
        return alone
    u = qmc.Sobol(materials, scramble=False).random(n)
    total, rest = u[:, 0], np.ones(n)
    mixed = np.empty((n, materials))
    for m in range(materials - 1):  # breaks a stick of length 1
        mixed[:, m] = rest * u[:, m + 1]
        rest = rest - mixed[:, m]
    mixed[:, -1] = rest
    return np.concatenate([alone, mixed * total[:, None]])
