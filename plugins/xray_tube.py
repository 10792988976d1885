"""The emitter `xray_tube`: the photons of a scan, by energy, the focal spot that they come from, and how they scatter."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.errors import InputError
from lingo_mi.effects.focal_spot import FocalSpot
from lingo_mi.effects.hardening import Tube, TubeParameters
from lingo_mi.effects.scatter import Scatter


class XRayTube(mi.Emitter):
    r"""
    .. _emitter-xray_tube:

    X-ray tube (:monosp:`xray_tube`)
    --------------------------------

    .. pluginparameters::

     * - energy
       - |float|
       - Photons of one energy, keV. Either this or `kvp`.
     * - kvp, angle, filtration
       - |float|, |float|, |string|
       - The spectrum of a tube with a tungsten anode (spekpy): peak voltage from 20 to 300 kV, anode angle in degrees,
         and filters with their thickness in mm, "Al 2.5, Cu 0.1". (Default: none, 12, "Al 2.5")
     * - reference
       - |float|
       - The energy, keV, at which the densities in the scene are attenuation in 1/mm.
         (Default: `energy`, which then changes nothing; 60 for a spectrum)
     * - material
       - |string|
       - What the objects are made of: `water`, `soft tissue`, `bone`, `pmma`, a compound of the NIST database as xraylib
         spells it, an element's symbol, or a formula with its density in g/cm3, "CsI @ 4.51". Two of them, "soft tissue
         + bone", are told apart by `split` in a grid, by the attribute `second` [N, 1] in ellipsoids: the second
         one's share in the density of every Gaussian, 0 to 1.
     * - material_NAME
       - |string|
       - The material of the shape whose id is NAME, if it is another.
     * - split
       - |string|
       - "0.024, 0.040": densities, 1/mm, up to which a voxel is the first of two materials, and from which it is the
         second; its share rises linearly between.
     * - bands
       - |int|
       - Terms of the sum that stands for the spectrum, 1 to 6. With 5, values up to 10 of a detector of energy are right to
         5e-6 for water, 4e-4 for bone and 5e-3 for iron (120 kVp). A detector of counts has up to twice these errors.
         (Default: 5)
     * - focal_spot
       - |string|
       - Width and height of the focal spot in mm, along the panel's u and v; one number stands for both. A uniform
         rectangle parallel to the panel. (Default: 0, a point)
     * - focal_order
       - |int|
       - n of n x n Gauss-Legendre points on it, 1 to 16; each point is a projection. (Default: 3)
     * - scatter
       - |int|
       - Paths of scattered photons, of each energy, that are traced to every point of a coarse grid on the panel. Needs
         `material`.
         (Default: 0, no scatter)
     * - scatter_grid
       - |string|
       - Rows and columns of that grid, 4 to 256; one number stands for both. (Default: 16)
     * - scatter_orders
       - |int|
       - The most times that a photon scatters; -1 is any number. (Default: -1)
     * - scatter_energies
       - |int|
       - Energies that stand for the spectrum, 1 to 16.
         (Default: 3)
     * - scatter_voxels
       - |int|
       - Voxels along the longest side of the box of all objects, on which they are sampled for it, 1 to 512. A single
         grid is used as it is. (Default: 64)
     * - scatter_box
       - |string|
       - "x0, y0, z0, x1, y1, z1": the lowest and the highest corner, mm, of a box outside which nothing scatters.
         (Default: the box of all objects, Gaussians out to 4 standard deviations)
     * - scatter_seed
       - |int|
       - Of its random numbers. (Default: 0)

    It is read by `lingo_xray`, which then gives -ln of the detected signal, and by `lingo_mi.scene.simulate`. To Mitsuba's
    own integrators it is dark.
    """

    def __init__(self, props):
        try:
            spot = FocalSpot.of(props.get('focal_spot', '0'), props.get('focal_order', 3))
            names = props.keys()
            materials: dict[str, Any] = {
                k.removeprefix('material_'): props[k] for k in names if k.startswith('material_')
            }
            scatter = Scatter.of(*(props.get(k, d) for k, d in _SCATTER.items()))
            parameters: dict[str, Any] = {
                f.name: props.get(f.name, f.default) for f in fields(TubeParameters) if f.name != 'materials'
            }
            tube = Tube.of(TubeParameters(**parameters, materials=materials))
        except InputError as error:
            raise InputError(f'xray_tube {props.id()!r}: {error}') from None
        super().__init__(props)
        self.tube, self.spot, self.scatter = tube, spot, scatter
        self.m_flags = mi.EmitterFlags.DeltaPosition

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Spectrum:
        return mi.Spectrum(0)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool | bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)

    def sample_ray(
        self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool | bool = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        return dr.zeros(mi.Ray3f), mi.Spectrum(0)

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool | bool = True) -> mi.Float:
        return mi.Float(0)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        pass

    def to_string(self) -> str:
        return f'XRayTube[\n  {self.tube},\n  {self.spot},\n  {self.scatter or "no scatter"}\n]'


create = XRayTube

_SCATTER = dict(
    scatter=0,
    scatter_grid='16',
    scatter_orders=-1,
    scatter_voxels=64,
    scatter_energies=3,
    scatter_seed=0,
    scatter_box='',
)
