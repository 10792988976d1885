"""Beam hardening: objects of one or two materials under a spectrum (Dr.Jit), and its correction in volumes (NumPy).

The density of an object is its attenuation at the tube's reference energy E0. At another energy E, material m attenuates
mu_m(E) / mu_m(E0) times as much. So one line integral of the density per material suffices; `bands` converts them to the
measured signal.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import drjit as dr
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.effects import bands as energy_bands
from lingo_mi.effects.spectrum import Spectrum, attenuation, monochromatic, tube_spectrum

REFERENCE = 60.0  # keV; water attenuates .0206 per mm
LARGEST = 10.0  # measured line integral up to which bands are fitted; 5e-5 of the signal remains there


@dataclass(frozen=True)
class TubeParameters:
    """The parameters of `xray_tube` that concern its spectrum, as a scene gives them; see its documentation.

    Parameters
    ----------
    materials : dict[str, str]
        Materials of single shapes, by name: the parameters material_NAME.
    """

    energy: float | None = None
    kvp: float | None = None
    angle: float = 12.0
    filtration: str = 'Al 2.5'
    reference: float | None = None
    material: str = ''
    split: str = ''
    bands: int = 5
    materials: dict[str, str] = field(default_factory=dict)

    def named(self) -> dict:
        """The parameters by their names in a scene."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != 'materials'}
        return values | {f'material_{name}': text for name, text in self.materials.items()}


@dataclass(frozen=True)
class Tube:
    """A spectrum, and the materials of the objects it passes.

    Parameters
    ----------
    reference : float
        Energy at which densities are attenuation in 1/mm, keV.
    material : tuple[str, ...]
        Names of one or two materials, as for `spectrum.attenuation`; empty if a scene does not name any.
    materials : dict[str, tuple[str, ...]]
        The same for single shapes, by name.
    split : tuple[float, float] or None
        Densities between which a grid of two materials changes from the first to the second, 1/mm.
    bands : int
        Number of terms for the spectrum.
    parameters : dict
        The parameters of `of`, by name; the parameters of shapes are called material_NAME.
    """

    spectrum: Spectrum
    reference: float
    material: tuple[str, ...] = ()
    materials: dict[str, tuple[str, ...]] = field(default_factory=dict)
    split: tuple[float, float] | None = None
    bands: int = 5
    parameters: dict = field(default_factory=dict, compare=False)

    @staticmethod
    def of(p: TubeParameters) -> Tube:
        """Checked parameters. Raises InputError."""
        energy, kvp, reference, bands = p.energy, p.kvp, p.reference, p.bands
        for name, value in dict(energy=energy, kvp=kvp, angle=p.angle, reference=reference).items():
            if not (value is None or isinstance(value, (int, float)) and not isinstance(value, bool)):
                raise InputError(f'{name} must be a number, not {value!r}')
        if energy is not None and kvp is None:
            spectrum, usual = monochromatic(energy), energy
        elif kvp is not None and energy is None:
            spectrum, usual = tube_spectrum(kvp, p.angle, p.filtration), REFERENCE
        else:
            raise InputError('a tube needs either an energy or a kvp')
        if reference is None:
            reference = usual
        if not 1 <= reference <= 1000:
            raise InputError(f'reference must be from 1 to 1000 keV, not {reference:g}')
        if isinstance(bands, bool) or not isinstance(bands, int) or not 1 <= bands <= energy_bands.MOST_BANDS:
            raise InputError(f'bands must be a whole number from 1 to {energy_bands.MOST_BANDS}, not {bands!r}')
        named = {name: _names(text) for name, text in p.materials.items()}
        tube = Tube(
            spectrum=spectrum,
            reference=float(reference),
            material=_names(p.material) if p.material else (),
            materials=named,
            split=_split(p.split),
            bands=bands,
            parameters=p.named(),
        )
        for names in (tube.material, *named.values()):
            for name in names:
                attenuation(name, [tube.reference])
            if len(names) == 2 and tube.split is None:
                raise InputError(
                    f'the two materials {" + ".join(names)!r} need a split, the densities in 1/mm that '
                    "tell them apart: '0.024, 0.040'"
                )
        return tube

    @property
    def hardens(self) -> bool:
        """True if the spectrum changes line integrals: photons of the reference energy alone do not."""
        return not (len(self.spectrum.energies) == 1 and self.spectrum.energies[0] == self.reference)

    def materials_of(self, name: str) -> tuple[str, ...]:
        """The materials of a shape.

        Raises
        ------
        InputError
            If the scene does not name them.
        """
        names = self.materials.get(name, self.material)
        if not names:
            raise InputError(
                f'xray_tube: the shape {name!r} has no material, without which a spectrum says nothing: add '
                f'<string name="material_{name}" value="water"/>'
            )
        return names

    def fitted(self) -> tuple[str, ...]:
        """The materials of all objects, one or two, for a fitted cloud, which has no shapes. Raises InputError.

        Two of different shapes come in the order of their attenuation, as `split` tells them apart.
        """
        names = tuple(dict.fromkeys([*self.material, *(name for shape in self.materials.values() for name in shape)]))
        if not names:
            raise InputError(
                'xray_tube: without a material a spectrum says nothing: add <string name="material" '
                'value="water"/>, or leave it out '
                "with effects='ignore'"
            )
        if len(names) > 2 or len(names) == 2 and self.split is None:
            raise InputError(
                f'xray_tube: a fit tells two materials apart by their densities, not {" + ".join(names)}: '
                + ('keep two of them' if len(names) > 2 else 'add a split, the densities in 1/mm between them')
                + ", or leave it out with effects='ignore'"
            )
        if len(names) == 2 and names != self.material:
            names = tuple(sorted(names, key=lambda name: attenuation(name, [self.reference])[0]))
        return names

    def of_cloud(self) -> Tube:
        """The tube of a fitted cloud, which stands for all shapes.

        Raises
        ------
        InputError
            As `fitted`.
        """
        return replace(self, material=self.fitted(), materials={})

    def signal(self, names: Iterable[str], response: str = 'energy') -> energy_bands.Bands:
        """The bands for materials (names). response: the detector integrates 'energy' or counts photons ('count')."""
        ratios = [attenuation(n, self.spectrum.energies) / attenuation(n, [self.reference]) for n in names]
        return energy_bands.band(self.spectrum.detected(response), ratios, self.bands, LARGEST)

    def __str__(self):
        e = self.spectrum.energies
        light = f'{e[0]:g} keV' if len(e) == 1 else f'up to {e[-1]:g} keV, mean {self.spectrum.mean:.1f} keV'
        return f'{light}, reference = {self.reference:g} keV, material = {" + ".join(self.material) or "none"}'


def hardened(integrals: Sequence, bands: energy_bands.Bands) -> Any:
    """The measured signal for line integrals at the reference energy, one Float [pixels] per material.

    Differentiable. The error in float32 is 1e-6 for any integrals.
    """
    exponents: list[Any] = [sum(float(r) * p for r, p in zip(ratios, integrals)) for ratios in bands.ratios.T]
    if len(exponents) == 1:
        return exponents[0]
    least = exponents[0]
    for e in exponents[1:]:
        least = dr.minimum(least, e)
    least = dr.detach(least)  # any constant is valid; this one avoids underflow of the largest term
    total: Any = sum(float(w) * dr.exp(least - e) for w, e in zip(bands.weights, exponents))
    return least - dr.log(total)


def by_material(objects: Iterable, tube: Tube) -> dict[str, list]:
    """For each material, the objects of a scene (`projectors.objects`), or parts of objects, made of it."""
    out = {}
    for obj in objects:
        names = tube.materials_of(obj.name)
        parts = [obj] if len(names) == 1 else _parts(obj, tube.split)
        for name, part in zip(names, parts):
            out.setdefault(name, []).append(part)
    return out


def second_share(density: Any, split: tuple[float, float]) -> Any:
    """The share of the second of two materials at a density (Dr.Jit or NumPy array)."""
    low, high = split
    share = (density - low) * (1 / (high - low))
    return np.clip(share, 0, 1) if isinstance(share, np.ndarray) else dr.clip(share, 0, 1)


def _parts(obj, split):
    """Two copies of an object, with the densities of its two materials."""
    first, second = copy.copy(obj), copy.copy(obj)
    if hasattr(obj, 'data'):
        share = second_share(obj.data * obj.scale, split)
        first.data, second.data = obj.data * (1 - share), obj.data * share
    elif hasattr(obj, 'density'):
        if obj.second is None:
            raise InputError(
                f'the ellipsoids {obj.name!r} are of two materials, but have no attribute "second": give '
                "it the second one's share in the density of every Gaussian, 0 to 1"
            )
        first.density, second.density = obj.density * (1 - obj.second), obj.density * obj.second
    else:
        raise InputError(f'{obj.name!r}, a mesh or in a shapegroup, cannot be of two materials: give it one')
    return first, second


def _names(text) -> tuple[str, ...]:
    names = tuple(part.strip() for part in text.split('+')) if isinstance(text, str) else ()
    if len(names) not in (1, 2) or not all(names):
        raise InputError(f"material must be one or two names, 'soft tissue + bone', not {text!r}")
    return names


def _split(text) -> tuple[float, float] | None:
    if text == '':
        return None
    try:
        low, high = (float(x) for x in str(text).replace(',', ' ').split())
    except ValueError:
        low, high = np.nan, np.nan
    if not (np.isfinite(high) and 0 <= low < high):
        raise InputError(f"split must be two rising densities in 1/mm, '0.024, 0.040', not {text!r}")
    return low, high
