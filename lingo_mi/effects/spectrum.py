"""Spectra of X-ray tubes and attenuation of materials: tables of spekpy and xraylib (NumPy).

Both libraries come with `pip install '.[physics]'` in a checkout of lingo_mi. spekpy needs seconds for a spectrum, so spectra
are cached in the user's cache folder.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.arrays import short_repr
from lingo_mi.common.errors import InputError

STEP = 0.5  # keV, width of a spectrum's bins
LEAST_KVP, MOST_KVP = 20.0, 300.0

# Short names of materials in the NIST database of compounds, as xraylib spells it.
NAMES = {
    'water': 'Water, Liquid',
    'soft tissue': 'Tissue, Soft (ICRP)',
    'bone': 'Bone, Cortical (ICRP)',
    'pmma': 'Polymethyl Methacralate (Lucite, Perspex)',
}


@dataclass(frozen=True)
class Spectrum:
    """Photons by energy.

    Parameters
    ----------
    energies : ndarray
        [E] keV, ascending: the middles of the bins.
    photons : ndarray
        [E] their shares of all photons; they sum to 1.
    """

    energies: np.ndarray
    photons: np.ndarray

    __repr__ = short_repr

    @property
    def mean(self) -> float:
        """Mean energy, keV."""
        return float(self.energies @ self.photons)

    def detected(self, response: str) -> np.ndarray:
        """Shares [E] of a detector's signal: `energy` integrates the photons' energy, `count` counts them."""
        signal = self.photons * (self.energies if response == 'energy' else 1.0)
        return signal / signal.sum()


def monochromatic(energy: float) -> Spectrum:
    """Photons of one energy, keV.

    Raises
    ------
    InputError
        Unless it is positive and finite.
    """
    if not (np.isfinite(energy) and energy > 0):
        raise InputError(f'energy must be positive, in keV, not {energy:g}')
    return Spectrum(np.array([float(energy)]), np.ones(1))


def tube_spectrum(kvp: float, angle: float = 12.0, filtration: str = 'Al 2.5') -> Spectrum:
    """The spectrum of a tube with a tungsten anode, from spekpy (Poludniowski et al., Med. Phys. 48, 2021).

    Parameters
    ----------
    kvp : float
        Peak voltage, kV, 20 to 300.
    angle : float
        Angle of the anode, degrees, above 0 and below 90.
    filtration : str
        'Al 2.5, Cu 0.1': materials and thicknesses in mm; may be empty.

    Raises
    ------
    InputError
        If a parameter is out of range, spekpy does not know a material, or it is not installed.
    """
    if not LEAST_KVP <= kvp <= MOST_KVP:
        raise InputError(f'kvp must be from {LEAST_KVP:g} to {MOST_KVP:g} kV, not {kvp:g}')
    if not 0 < angle < 90:
        raise InputError(f'angle, of the anode, must be above 0 and below 90 degrees, not {angle:g}')
    filters = _filters(filtration)
    name = '_'.join([f'{kvp:g}kV', f'{angle:g}deg', f'{STEP:g}keV', *(f'{m}{t:g}mm' for m, t in filters)])
    path = _cache_folder() / f'spekpy-{_version("spekpy")}_{re.sub(r"[^A-Za-z0-9.]", "_", name)}.npz'
    try:
        with np.load(path) as table:
            cached = Spectrum(table['energies'], table['photons'])
        if abs(cached.photons.sum() - 1) < 1e-6:
            return cached
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # no cached file yet, or a damaged one
        pass
    tube = library('spekpy').Spek(kvp=kvp, th=angle, dk=STEP)
    try:
        for material, thickness in filters:
            tube.filter(material, thickness)
        energies, photons = tube.get_spectrum(edges=False)
    except Exception as error:  # spekpy raises plain Exceptions
        raise InputError(f'filtration {filtration!r}: spekpy cannot compute it ({str(error).strip()})') from None
    if not (np.isfinite(photons).all() and photons.sum() > 0):
        raise InputError(f'filtration {filtration!r}: no photon of {kvp:g} kV passes it')
    spectrum = Spectrum(energies, photons / photons.sum())
    _store(path, spectrum)
    return spectrum


def attenuation(material: str, energies: ArrayLike) -> np.ndarray:
    """Linear attenuation coefficients, 1/mm, at energies in keV, with coherent scattering (xraylib).

    Parameters
    ----------
    material : str
        A short name of `NAMES`, a compound of the NIST database as xraylib spells it, an element's symbol, or a chemical formula
        with its density in g/cm3: 'CsI @ 4.51'.

    Raises
    ------
    InputError
        For an unknown material, for energies that xraylib does not know, or if it is not installed.
    """
    xraylib = library('xraylib')
    formula, density = compound(material)
    try:
        mass = [xraylib.CS_Total_CP(formula, float(e)) for e in np.atleast_1d(energies)]  # cm2/g
    except ValueError as error:
        least, most = np.min(energies), np.max(energies)
        raise InputError(f'{material}: xraylib has no attenuation from {least:g} to {most:g} keV ({error})') from None
    return np.array(mass) * density / 10


def compound(material: str) -> tuple[str, float]:
    """A material's name in xraylib, and its density in g/cm3.

    Raises
    ------
    InputError
        As `attenuation` does.
    """
    xraylib = library('xraylib')
    formula, at, density = (part.strip() for part in material.partition('@'))
    formula = NAMES.get(formula.lower(), formula)
    try:
        if at:
            density = float(density)
        elif formula in xraylib.GetCompoundDataNISTList():
            density = xraylib.GetCompoundDataNISTByName(formula)['density']
        else:
            density = xraylib.ElementDensity(xraylib.SymbolToAtomicNumber(formula))
        xraylib.CS_Total_CP(formula, 60.0)
    except ValueError:
        raise InputError(
            f'the material {material!r} is unknown: use {", ".join(NAMES)}, a compound of the NIST '
            "database, an element's symbol, or a formula with its density in g/cm3: 'CsI @ 4.51'"
        ) from None
    if not (np.isfinite(density) and density > 0):
        raise InputError(f'the material {material!r} must have a positive density, in g/cm3')
    return formula, density


def _filters(text: str) -> list[tuple[str, float]]:
    """Materials and thicknesses, mm, from 'Al 2.5, Cu 0.1'."""
    out = []
    if not isinstance(text, str):
        raise InputError(f"filtration must be materials and thicknesses in mm, 'Al 2.5, Cu 0.1', not {text!r}")
    for item in filter(None, (part.strip() for part in text.split(','))):
        material, _, number = item.rpartition(' ')
        try:
            thickness = float(number)
        except ValueError:
            thickness = np.nan
        if not (material.strip() and np.isfinite(thickness) and thickness >= 0):
            raise InputError(f"filtration must be materials and thicknesses in mm, 'Al 2.5, Cu 0.1', not {text!r}")
        out.append((material.strip(), thickness))
    return out


def library(name: str) -> Any:
    """The module spekpy or xraylib.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(_MISSING.format(name)) from None


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        raise InputError(_MISSING.format(name)) from None


_MISSING = "{} is not installed: pip install '.[physics]' in a checkout of lingo_mi"


def _cache_folder() -> Path:
    root = os.environ.get('XDG_CACHE_HOME') or os.environ.get('LOCALAPPDATA') or Path.home() / '.cache'
    return Path(root) / 'lingo_mi' / 'spectra'


def _store(path: Path, spectrum: Spectrum):
    """Cache a spectrum. If the folder cannot be written, only time is lost."""
    part = path.with_name(f'{path.stem}.{os.getpid()}.npz')  # renamed when complete: other processes never read a part
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(part, energies=spectrum.energies, photons=spectrum.photons)
        os.replace(part, path)
    except OSError:
        pass
