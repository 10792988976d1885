"""The film `ct_detector`: what a flat panel makes of the photons that reach it."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

import mitsuba as mi

from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import require_whole


class CTDetector(mi.Film):
    r"""
    .. _film-ct_detector:

    CT detector (:monosp:`ct_detector`)
    -----------------------------------

    .. pluginparameters::

     * - photons
       - |float|
       - Photons a pixel counts in the open beam, I0. With it the counts have Poisson noise. (Default: 0, no noise)
     * - electronic_noise
       - |float|
       - Standard deviation of the read-out noise, in photons. Needs `photons`. (Default: 0)
     * - response
       - |string|
       - `energy`: the signal is the energy of the photons, as for a scintillator; `count`: their number.
         (Default: energy)
     * - psf
       - |float|
       - Full width at half maximum of the scintillator's point spread, a Gaussian, mm on the panel. (Default: 0)
     * - aperture, aperture_order
       - |float|, |int|
       - The sensitive share of a pixel's pitch, 0 to 1, and n of its n x n Gauss-Legendre points, 1 to 16, each of
         which is a projection. (Default: 0, the ray through its centre; 3)
     * - saturation
       - |float|
       - The largest signal, in units of the open beam's. Derivatives by what is brighter are zero. (Default: none)
     * - bits
       - |int|
       - Bit depth of the converter, 1 to 24, whose largest number is `saturation`, or 1.25 without one. (Default: none)
     * - dead
       - |float|
       - Share of pixels that give nothing, 0 to 1. (Default: 0)
     * - gain
       - |float|
       - Standard deviation of the pixels' gains around 1. (Default: 0)
     * - seed
       - |int|
       - Which pixels are dead and what the gains are. (Default: 0)
     * - corrected
       - |boolean|
       - Whether gains are divided out and dead pixels filled from their neighbours, as scanners do. (Default: true)

    Put it into a `ct_scanner`, whose pixels it takes, or into a camera with a width and a height of its own. `lingo_xray`
    renders it, noise included: its seed is the seed of `mi.render`, and the same seed and view give the same noise in any
    order. Derivatives are taken of the expected signal. Other integrators get an ordinary film (`hdrfilm`, box filter).
    """

    def __init__(self, props):
        try:
            self.detector = Detector.of(**{k: props.get(k, d) for k, d in Detector.DEFAULTS.items()})
        except InputError as error:
            raise InputError(f'ct_detector {props.id()!r}: {error}') from None
        super().__init__(props)
        require_whole(self, f'ct_detector {props.id()!r}')
        self.film = mi.load_dict(
            dict(
                type='hdrfilm',
                width=self.size()[0],
                height=self.size()[1],
                rfilter=dict(type='box'),
                component_format='float32',
                pixel_format='luminance',
            )
        )

    def base_channels_count(self) -> int:
        return self.film.base_channels_count()

    def prepare(self, aovs: Sequence[str]) -> int:
        return self.film.prepare(aovs)

    def put_block(self, block: mi.ImageBlock) -> None:
        self.film.put_block(block)

    def clear(self) -> None:
        self.film.clear()

    def develop(self, raw: bool = False) -> mi.TensorXf:
        return self.film.develop(raw)

    def bitmap(self, raw: bool = False) -> mi.Bitmap:
        return self.film.bitmap(raw)

    def write(self, path: str | PathLike) -> None:
        self.film.write(path)

    def create_block(
        self, size: mi.ScalarVector2u | None = None, normalize: bool = False, borders: bool = False
    ) -> mi.ImageBlock:
        return self.film.create_block(*([] if size is None else [size]), normalize=normalize, borders=borders)

    def to_string(self) -> str:
        return f'CTDetector[{self.detector}]'


create = CTDetector
