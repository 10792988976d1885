r"""Angular distribution of scattered photons: the Klein-Nishina formula, and bound electrons of materials (NumPy).

For a photon of energy E, alpha = E / (m c^2), on a free electron at rest (Klein and Nishina, Z. Phys. 52, 1929),

    d sigma / d Omega = r_e^2 / 2  P^2 (P + 1/P - sin^2 theta),    P = E' / E = 1 / (1 + alpha (1 - cos theta))

The electrons of a material are bound. For each atom, xraylib multiplies this by the incoherent scattering function S(q) and
adds the coherent (Rayleigh) part r_e^2 / 2 (1 + cos^2 theta) F(q)^2 (Schoonjans et al., Spectrochim. Acta B 66, 2011). Its
tables do not include the interference of neighbouring molecules, which moves the coherent peak of water by some degrees.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.effects.spectrum import compound, library

ELECTRON = 510.99895  # m c^2, keV
LEAST_ENERGY, MOST_ENERGY = 1.0, 800.0  # keV
# Cells of a table over cos theta from -1 to 1. The error is 2e-6 for a free electron; forward cells are 1.3 degrees wide.
CELLS = 8192
_FINE = 4096  # angles at which xraylib is evaluated
_LEAST_Q = 1.1e-3  # 1/Angstrom, lower end of xraylib's tables of S; there S is almost 0 and F almost at its maximum
_HC = 12.398420  # keV Angstrom


def klein_nishina(cosine: ArrayLike, energy: float, response: str = 'count') -> np.ndarray:
    """d sigma / d Omega of a free electron, divided by r_e^2, 1/sr, float64. cosine: of the scattering angle, any shape.

    Parameters
    ----------
    energy : float
        keV.
    response : str
        'energy' weights a photon by the share P of its energy that it keeps (the energy-scattering cross-section of Evans, "The
        Atomic Nucleus", 1955, ch. 23); 'count' weights it by 1.
    """
    cosine = np.asarray(cosine, float)
    energy_share = 1 / (1 + energy / ELECTRON * (1 - cosine))
    return (
        0.5 * energy_share ** (3 if response == 'energy' else 2) * (energy_share + 1 / energy_share - (1 - cosine**2))
    )


@lru_cache(maxsize=64)
def scattering(energy: float, material: str = '', response: str = 'count') -> tuple[np.ndarray, float]:
    """A table of d mu / d Omega, and its integral over all directions.

    The table is float64 [CELLS + 1], at equal steps of cos theta from -1 to 1 (forward). For a material, its values are means
    over the cells around the nodes.

    Parameters
    ----------
    energy : float
        keV, 1 to 800.
    material : str
        As for `spectrum.attenuation`: bound electrons with coherent scattering, in 1/mm. '': a free electron, divided by r_e^2.
    response : str
        As for `klein_nishina`, for the incoherent part; coherent scattering keeps the energy.

    Raises
    ------
    InputError
        For an energy out of range, and as `spectrum.attenuation` does.
    """
    if not LEAST_ENERGY <= energy <= MOST_ENERGY:
        raise InputError(f'energy must be from {LEAST_ENERGY:g} to {MOST_ENERGY:g} keV, not {energy:g}')
    if not material:
        return _cached(klein_nishina(np.linspace(-1, 1, CELLS + 1), energy, response))
    formula, density = compound(material)
    xraylib = library('xraylib')
    half = np.linspace(0, 1, _FINE + 1)[::-1] ** 2  # sin(theta / 2), which resolves a forward peak
    angles = (2 * np.arcsin(np.maximum(half, min(1.0, _LEAST_Q * _HC / energy)))).tolist()
    bound, coherent = (
        np.array([function(formula, float(energy), a) for a in angles])
        for function in (xraylib.DCS_Compt_CP, xraylib.DCS_Rayl_CP)
    )
    cosine = 1 - 2 * half**2
    energy_share = 1 / (1 + energy / ELECTRON * (1 - cosine)) if response == 'energy' else 1.0
    fine = (bound * energy_share + coherent) * density / 10  # cm2/g to 1/mm
    # Means over cells keep the integral of a forward peak narrower than a cell. The density is linear between fine angles, so
    # its integral is a parabola.
    edges = np.concatenate([[-1.0], (np.arange(CELLS) + 0.5) * (2 / CELLS) - 1, [1.0]])
    below = np.concatenate([[0.0], np.cumsum((fine[1:] + fine[:-1]) / 2 * np.diff(cosine))])
    i = np.clip(np.searchsorted(cosine, edges, 'right') - 1, 0, _FINE - 1)
    step = edges - cosine[i]
    slope = (fine[i + 1] - fine[i]) / (cosine[i + 1] - cosine[i])
    return _cached(np.diff(below[i] + step * (fine[i] + step * slope / 2)) / np.diff(edges))


def _cached(table):
    table.setflags(write=False)  # it is shared
    return table, float(4 * np.pi / CELLS * (table.sum() - (table[0] + table[-1]) / 2))
