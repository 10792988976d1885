"""The effects that a scene declares, and the signal of its detector with them (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import DARKEST, Detector
from lingo_mi.effects.focal_spot import FocalSpot, aperture_views
from lingo_mi.effects.hardening import Tube, by_material, hardened
from lingo_mi.effects.scatter import Scatter
from lingo_mi.geometry import CurvedGeometry
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.view import View
from lingo_mi.scan import Scan


@dataclass(frozen=True)
class Effects:
    """The effects of a scene; None for elements that it does not have.

    Parameters
    ----------
    tube, spot, scatter
        Spectrum, focal spot and scattered photons of its `xray_tube`.
    detector : Detector or None
        Detector of the sensor, from its `ct_detector`.
    index : int
        The sensor's view: with the seeds, the key of its noise.
    """

    tube: Tube | None = None
    spot: FocalSpot | None = None
    detector: Detector | None = None
    index: int = 0
    scatter: Scatter | None = None

    @property
    def ideal(self) -> bool:
        """True if the expected signal is exp(-line integral) along the ray through a pixel's centre."""
        return not (
            self.tube
            and self.tube.hardens
            or self.spot
            and max(self.spot.size)
            or self.scatter
            or self.detector
            and (self.detector.aperture or self.detector.psf or self.detector.saturation)
        )

    def scaled(self, factor: float) -> Effects:
        """The same for views whose lengths are mm times `factor`."""
        return replace(
            self,
            spot=self.spot and self.spot.scaled(factor),
            detector=self.detector and replace(self.detector, psf=factor * self.detector.psf),
        )

    @property
    def needs_materials(self) -> bool:
        """True if the effects depend on the materials of the objects."""
        return self.tube is not None and (self.tube.hardens or self.scatter is not None)

    def of_cloud(self) -> Effects:
        """The same for a fitted cloud, or a volume, that stands for all shapes.

        Raises
        ------
        InputError
            As `Tube.fitted`.
        """
        return replace(self, tube=self.tube.of_cloud()) if self.tube and self.needs_materials else self

    @property
    def response(self) -> str:
        return self.detector.response if self.detector else 'energy'

    def views(self, view: View) -> list[tuple[float, View]]:
        """(weight, View) of all ray bundles; a view's pixels measure their mean intensity."""
        views = self.spot.views(view) if self.spot else [(1.0, view)]
        if self.detector:
            d = self.detector
            views = [
                (w * share, v)
                for w, bundle in views
                for share, v in aperture_views(bundle, d.aperture, d.aperture_order)
            ]
        return views

    def line_integrals(self, objects: list, view: View, options: RenderOptions) -> Any:
        """The expected -ln(I / I0) of every pixel, Float [height * width]; differentiable.

        Parameters
        ----------
        objects : list
            Objects, as `projectors.objects.find_objects` gives them.
        options : RenderOptions
            Its n x n rays per pixel are averaged as intensities; a detector with an `aperture` has points of its own in every
            pixel.
        """
        options = self._rays(options)
        groups, bands = {'': objects}, None
        if self.tube and self.tube.hardens:
            groups = by_material(objects, self.tube)
            bands = self.tube.signal(groups, self.response)

        def along(view):
            rays = options.subdivided(view)
            integrals = []
            for members in groups.values():
                total = dr.zeros(mi.Float, rays.height * rays.width)
                for obj in members:
                    total += obj.line_integrals(rays, options)
                integrals.append(total)
            return hardened(integrals, bands) if bands else integrals[0]

        scattered = None
        if self.scatter and self.tube:
            scattered = self.scatter.light(objects, self.tube, self.response, view, self.index)
        return self.averaged(along, view, options, scattered)

    def _rays(self, options):
        return replace(options, pixel=1, area=False) if self.detector and self.detector.aperture else options

    def averaged(self, along: Callable[[View], Any], view: View, options: RenderOptions, scattered: Any = None) -> Any:
        """-ln of the mean intensity of all rays of a pixel, after the detector's blur.

        Parameters
        ----------
        along : callable
            Function of a View: -ln of the intensity along its rays, Float.
        scattered
            Scattered intensity to add, relative to the open beam's, Float [height * width].
        """
        views = self.views(view)
        blurring = self.detector if self.detector and self.detector.psf else None
        if len(views) == 1 and options.pixel == 1 and blurring is None and scattered is None:
            return along(view)
        light = mi.Float(0)
        for weight, bundle in views:
            light += dr.opaque(mi.Float, weight) * options.averaged(dr.exp(-along(bundle)), view)
            if len(views) > 1:  # one small kernel, launched for each, instead of a large one that takes long to compile
                dr.eval(light)
        if scattered is not None:
            light += scattered
        if blurring is not None:
            light = blurring.blurred(light, view)
        return -dr.log(dr.maximum(light, DARKEST))

    def saturated(self, integrals: Any, view: View) -> Any:
        """Expected -ln(I / I0) with saturation, Float [height * width]. The derivative of saturated pixels is zero."""
        if not (self.detector and self.detector.saturation):
            return integrals
        return dr.maximum(integrals, mi.Float(self.detector.saturates((view.height, view.width)).ravel()))

    def expected(self, integrals: Any, view: View) -> Any:
        """-ln of the signal that `measured` gives without noise: saturated, with the gains that the detector leaves in."""
        saturated = self.saturated(integrals, view)
        if not (self.detector and self.detector.gain) or self.detector.corrected:
            return saturated
        return saturated - mi.Float(np.log(self.detector.maps((view.height, view.width))[0]).ravel())

    def masked(self, scan: Scan) -> Scan:
        """The scan with dead pixels invalid."""
        if not (self.detector and self.detector.dead):
            return scan
        alive = ~self.detector.maps(scan.geometry.nDetector)[1]
        valid = np.ones(scan.projections.shape, bool) if scan.valid is None else scan.valid
        return replace(scan, valid=valid & alive)

    def binned(self, pixels: int) -> Effects:
        """The effects after binning by that many pixels, which leaves dead pixels out."""
        return replace(self, detector=self.detector and self.detector.binned(pixels))

    def without_hardening(self, projections: np.ndarray) -> np.ndarray:
        """Projections [view, v, u] at the reference energy: beam hardening is inverted, pixel by pixel, for a single material,
        the first of two (water precorrection, Kachelriess et al., Med. Phys. 33, 2006)."""
        if not (self.tube and self.tube.hardens):
            return projections
        bands = self.tube.signal(self.tube.fitted()[:1], self.response)
        out = np.empty_like(projections)
        for i, view in enumerate(projections):  # one by one, for memory
            out[i] = bands.precorrected(view)
        return out

    def measured(self, integrals: Any, view: View, seed: int) -> Any:
        """Line integrals as the detector reports them, with noise, from expected ones. Not differentiable."""
        if not (self.detector and self.detector.measures):
            return integrals
        light = np.exp(-integrals.numpy().astype(float)).reshape(view.height, view.width)
        return mi.Float(self.detector.measure(light, self.index, seed).ravel())


def effects_of(scan: Scan) -> Effects | None:
    """The effects of a scan. `scan`, in a package below this one, knows only two of their methods."""
    return cast('Effects | None', scan.effects)


def require_whole(film: Any, where: str) -> None:
    """Raises InputError for a film with a crop window. where: whose it is, for the message."""
    if any(film.crop_size()[i] != film.size()[i] for i in (0, 1)):
        raise InputError(
            f'{where}: cannot have a crop window, since blur, gains, noise and scatter concern the whole panel; crop the image'
        )


def find_effects(scene: Any, sensor: Any) -> Effects | None:
    """The effects of a scene with a sensor; None without any.

    Raises
    ------
    InputError
        For impossible ones.
    """
    tubes = [e for e in scene.emitters() if hasattr(e, 'tube')]
    detector = getattr(sensor, 'detector', None) or getattr(sensor.film(), 'detector', None)
    if not tubes and detector is None:
        return None
    geometry = getattr(sensor, 'geometry', None)
    if isinstance(geometry, CurvedGeometry):
        raise InputError(
            'effects of a tube and a detector are modelled on flat panels alone: leave out xray_tube and ct_detector, or the '
            'radius of the panel'
        )
    if len(tubes) > 1:
        raise InputError(f'the scene has {len(tubes)} emitters xray_tube: keep one')
    tube, spot, scatter = (tubes[0].tube, tubes[0].spot, tubes[0].scatter) if tubes else (None, None, None)
    shapes = {shape.id() for shape in scene.shapes()} | {'volume'}  # a scanned volume stands in for the shapes
    if tube is not None and (unknown := sorted(tube.materials.keys() - shapes)):
        raise InputError(
            f'xray_tube {tubes[0].id()!r}: material_{unknown[0]} names none of the shapes {", ".join(sorted(shapes))}'
        )
    if detector is not None or scatter is not None:
        require_whole(sensor.film(), f'the film of {sensor.id()!r} under a ct_detector or with scatter')
    if detector is not None and detector.psf and geometry is None:
        raise InputError('ct_detector: psf, in mm on the panel, needs a ct_scanner')
    if scatter is not None and geometry is None:
        raise InputError(f'xray_tube {tubes[0].id()!r}: scatter needs a ct_scanner, whose panel it reaches')
    if spot is not None and max(spot.size) > 0 and geometry is None:
        raise InputError(f'xray_tube {tubes[0].id()!r}: focal_spot, in mm, needs a ct_scanner, whose panel it blurs')
    if spot is not None and geometry is not None:
        try:
            spot.check(None if geometry.mode == 'parallel' else geometry.DSO)
        except InputError as error:
            raise InputError(f'xray_tube {tubes[0].id()!r}: {error}') from None
    return Effects(tube, spot, detector, getattr(sensor, 'index', 0), scatter)
