"""What a scan's detector sees of a cloud: the effects of a scan inside the fit's forward model."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from lingo_mi.effects.forward import Effects
from lingo_mi.effects.hardening import hardened, second_share
from lingo_mi.errors import InputError
from lingo_mi.fit.scatter import Scattered
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.upload import uploaded
from lingo_mi.reconstruction import effects_correction as corrections
from lingo_mi.scan import Scan

RENEWED = 50  # steps after which the shares of two materials are looked at again


class Model:
    """The expected signal of a scan's detector, in the frame and the unit of a fit.

    A line integral q of the fit is p = factor q at the tube's reference energy, without a unit, and pixels are compared as
    -ln(I / I0) / factor. Two materials are told apart as in a grid, by the density at a Gaussian's centre (Joseph and
    Spital, J. Comput. Assist. Tomogr. 2, 1978, who divide a first reconstruction so); the shares are constants to the
    derivatives and are renewed now and then.

    effects     with lengths in the fit's frame
    bands       of the spectrum; None where no material matters
    split       densities between which the second material's share rises, 1/mm; None for one material
    scattered   what the cloud scatters; None where the scan is without
    """

    def __init__(self, effects: Effects, geometry: Geometry, unit: float):
        """unit: the density that counts as 1, 1/mm."""
        self.effects = effects.scaled(geometry.scale)
        self.factor = dr.opaque(mi.Float, unit / geometry.scale)
        self.bands, self.split = None, None
        self.scattered = Scattered(effects, geometry) if effects.scatter else None
        if effects.tube and (effects.tube.hardens or effects.scatter):
            names = effects.tube.fitted()
            self.bands = effects.tube.signal(names, effects.response)
            self.split = effects.tube.split if len(names) == 2 else None

    def image(self, integrals, view, scattered=None):
        """What the pixels of a view are expected to be, Float [height * width]; differentiable.

        integrals   gives line integrals along the rays of a View, one Float a material
        scattered   light over the open beam's, Float [height * width], a constant to the derivatives; None: none
        """

        def seen(rays):
            parts = [self.factor * q for q in integrals(rays)]
            return hardened(parts, self.bands) if self.bands else parts[0]

        return self.effects.saturated(self.effects.averaged(seen, view, RenderOptions(), scattered), view) / self.factor

    def shares(self, volume, centres, half):
        """The second material's share in every Gaussian's density, Float [N]; None for one material.

        volume    [x, y, z], the cloud's density, 1/mm
        centres   [N, 3] and half, [3], half the volume's sides: both in the fit's frame
        """
        if self.split is None:
            return None
        place = (np.asarray(centres, float) / half + 1) / 2 * volume.shape - 0.5
        density = ndimage.map_coordinates(volume, place.T, order=1, mode='nearest')
        return uploaded(second_share(density.astype(float), self.split))


def model_of(scan: Scan, settings, unit: float) -> Model | None:
    """The model of a scan's effects; None where the fit compares line integrals, because it has none or they are ignored.

    Raises InputError for effects that a fit cannot reproduce.
    """
    effects = scan.effects if settings.effects == 'model' else None
    if effects is None or effects.ideal:
        return None
    return Model(effects, scan.geometry, unit)


def weights_of(scan: Scan, settings) -> np.ndarray | None:
    """What pixels are multiplied by before they are compared, float32 [view, v, u]; None where they are as they are.

    One over the standard deviation of a pixel's noise, so that all have the same (as the weights of penalised weighted least
    squares, Sauer and Bouman, IEEE Trans. Signal Process. 41, 1993, which are squares of these). It follows the mean signal of
    3 x 3 valid pixels: by its own noise alone a pixel that came out dark would count for less than a bright one. The largest
    projection stays as large as it was, for the sake of the loss's constants.

    Raises InputError for a scan that says neither how many photons it has counted nor its bit depth.
    """
    if settings.weights == 'equal':
        return None
    detector = scan.effects.detector if scan.effects else None
    if not (detector and (detector.photons or detector.bits)):
        raise InputError('weights=noise needs a ct_detector with photons or bits in the scene, or leave it out')
    p = scan.projections
    valid = np.ones(p.shape) if scan.valid is None else scan.valid.astype(float)
    light, share = (
        ndimage.uniform_filter(a, (0, 3, 3), mode='nearest') for a in (np.exp(-p.astype(float)) * valid, valid)
    )
    weights = 1 / detector.deviation(light / np.maximum(share, 0.1))
    return (weights * (p.max() / (weights * p).max())).astype(np.float32)


def trusted(scan: Scan, settings) -> Scan:
    """The scan without the pixels that its detector knows to be dead."""
    effects = scan.effects if settings.effects == 'model' else None
    return scan if effects is None else effects.masked(scan)


def linearised(scan: Scan, settings) -> Scan:
    """A scan of line integrals at the reference energy for what knows no effects: initial clouds, FDK."""
    effects = scan.effects if settings.effects == 'model' else None
    return scan if effects is None else corrections.linearised(scan, effects)
