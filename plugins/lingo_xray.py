"""The integrator `lingo_xray`: exact X-ray line integrals, forward and backward."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import find_effects
from lingo_mi.projectors.objects import find_objects
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.sensors import views_of
from lingo_mi.projectors.usable import require_unfrozen


class LingoXray(mi.ad.integrators.common.ADIntegrator):
    r"""
    .. _integrator-lingo_xray:

    X-ray line integrals (:monosp:`lingo_xray`)
    -------------------------------------------

    .. pluginparameters::

     * - accuracy
       - |string|
       - A preset of the cut-off, with these relative L2 errors of an image and its derivatives, and times relative
         to the default's (docs/accuracy.md names the objects):

         =============  =======  ========  =================  ======  ==============
         preset         extent   image     worst derivative   time    with gradients
         =============  =======  ========  =================  ======  ==============
         `draft`        3        6e-03     5e-02              0.6     0.6
         `default`      5        2e-06     4e-05              1.0     1.0
         `reference`    7        1e-07     2e-07              1.6     1.5
         =============  =======  ========  =================  ======  ==============

         (Default: `default`)
     * - extent
       - |float|
       - Cut-off of Gaussians in standard deviations, whatever the preset says.
     * - footprint
       - |string|
       - `exact`, the closed form; or `affine`, the EWA model of Gaussian splatting, to compare with: for Gaussians of a
         few pixels it is off by 2e-4 to 4e-4, its derivatives by 1e-3 to 5e-3; exact in parallel beams, and not faster.
         (Default: `exact`)
     * - pixel
       - |string| or |int|
       - `centre`, the ray through a pixel's centre; `area`, the mean over the pixel in closed form, at hardly more cost, for
         scenes of Gaussians alone (each footprint is convolved with a Gaussian of the pixel's variance; the relative
         error is 1e-3 if a standard deviation is one pixel, and falls with the fourth power of their ratio); or n, the mean
         over n x n rays, for pixels that are not small against any object. `area` averages line integrals, and n averages
         transmissions, as a detector does; at edges they differ. Time and memory grow with n x n.
         (Default: `centre`)
     * - output
       - |string|
       - `line_integral`, the integral of the density along the ray, ln(I0 / I); or `transmission`, I / I0 = exp(-integral).
         If an integral is below -88, the transmission overflows float32 to infinity. There is no warning, because the check
         would make every rendering wait for the device.
         (Default: `line_integral`)

    Beer-Lambert line integrals through everything in the scene that attenuates:

    - `ellipsoids` shapes with a `density` attribute: a cloud of 3D Gaussians, in closed form (see
      `lingo_mi.projectors.footprint`); density is the value at a Gaussian's centre, and the sum needs no order;
    - a `cube` with an interior `heterogeneous` medium on a `gridvolume`: exact for trilinear interpolation. Mitsuba does
      not tell which `filter_type` and `wrap_mode` a volume has, so the defaults, `trilinear` and `clamp`, are assumed;
    - a closed mesh with an interior `homogeneous` medium: exact path lengths by rasterisation;
    - an `instance` of a `shapegroup` of such shapes, moved by its `to_world`.

    An emitter `xray_tube` (spectrum, focal spot) and a film `ct_detector` (blur, noise and more) make the image what a
    detector sees, -ln of the detected signal; docs/effects.md says how. Without them, nothing of their code is compiled.
    The seed of `mi.render` seeds the noise. Derivatives belong to the expected signal.

    Objects overlap additively. A kind of object that a scene lacks adds no code to its kernels. Rays go through pixel centres
    (see `pixel`): no random numbers, whatever the sample count. Sensors: `ct_scanner`, `perspective` and `orthographic`, and a
    `batch` of them, whose views stand side by side in its film. If the film has a crop window, only the window is rendered.
    Integrals begin at a cone beam's source, and do not end at the panel. Integrals of a parallel beam are never cut.

    Works in `llvm_ad_*` and `cuda_ad_*`, `mono` and `rgb`; not within `dr.freeze`, nor inside `aov` or `moment`, since it
    renders whole images and no single rays. The film gets the image, for `sensor.film().bitmap()`. Gradients reach the
    Gaussians' centres, scales, rotations and densities, the grid's values and its scale, a mesh's `sigma_t` (not its
    vertices, for which it raises an error) and the `to_world` of an instance, in forward and in reverse mode.
    """

    def __init__(self, props):
        super().__init__(props)
        self.options = RenderOptions.of(
            props.get('accuracy', 'default'),
            props.get('extent', None),
            props.get('footprint', 'exact'),
            props.get('pixel', 'centre'),
        )
        self.output = props.get('output', 'line_integral')
        if self.output not in ('line_integral', 'transmission'):
            raise InputError(f"lingo_xray: output is 'line_integral' or 'transmission', not {self.output!r}")

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        if not develop:
            raise InputError('lingo_xray renders with develop=True only: there are no samples to accumulate')
        require_unfrozen('mi.render with lingo_xray')
        with dr.suspend_grad():
            sensor = _sensor(scene, sensor)
            image = self._image(scene, sensor, seed=int(np.ravel(seed)[0]))  # of any type that Mitsuba takes
            _expose(sensor.film(), image)
            if evaluate:
                dr.eval(image)
            return image

    def render_forward(
        self, scene: mi.Scene, params: Any, sensor: mi.Sensor | int = 0, seed: int = 0, spp: int = 0
    ) -> mi.TensorXf:
        image = self._image(scene, _sensor(scene, sensor))
        dr.forward_to(image)
        return dr.grad(image)

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: mi.TensorXf,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> None:
        # A line integral is linear in what was splatted, so its image need not be computed again.
        image = self._image(scene, _sensor(scene, sensor), primal=self.output == 'transmission')
        dr.backward_from(image * grad_in)

    def sample(self, *_: Any, **__: Any) -> Any:
        """Return the value of a single ray for an integrator around this one. Raises InputError."""
        raise InputError(
            'lingo_xray renders whole images, no single rays: take it out of the integrator around it (aov, moment), and '
            'render that one by itself, mi.render(scene, integrator=...)'
        )

    def _image(self, scene, sensor, primal=True, seed=None):
        """The image as a tensor [height, width, channels of the film]; with a seed, as measured."""
        film = sensor.film()
        film.prepare([])
        channels = film.develop().shape[2]
        images = []
        for bundle, view in views_of(sensor):
            effects = find_effects(scene, bundle)
            if effects is None:
                total = self._ideal(find_objects(scene), view, primal)
            else:
                total = effects.line_integrals(find_objects(scene), view, self.options)
                total = effects.expected(total, view) if seed is None else effects.measured(total, view, seed)
                if self.output == 'transmission':
                    total = dr.exp(-total)
            if channels > 1:
                total = dr.repeat(total, channels)
            images.append(mi.TensorXf(total, shape=(view.height, view.width, channels)))
        return images[0] if len(images) == 1 else dr.concat(images, axis=1)

    def _ideal(self, objects, view, primal):
        """Line integrals, or transmissions, of every pixel of a scene without effects."""
        rays = self.options.subdivided(view)
        total = dr.zeros(mi.Float, rays.height * rays.width)
        for obj in objects:
            total += obj.line_integrals(rays, self.options, primal)
        if self.output == 'transmission':
            total = dr.exp(-total)
        return self.options.averaged(total, view)

    def to_string(self) -> str:
        o = self.options
        pixel = 'area' if o.area else f'{o.pixel} x {o.pixel}'
        return f'LingoXray[extent = {o.extent:g}, footprint = {o.footprint}, pixel = {pixel}, output = {self.output}]'


def _sensor(scene, sensor):
    return scene.sensors()[sensor] if isinstance(sensor, int) else sensor


def _expose(film, image):
    """Give a film, which was prepared, the image, so that `film.bitmap()` and `film.write()` have it."""
    block = film.create_block()
    height, width = image.shape[:2]
    channels = block.channel_count()  # colours, alpha if the film has it, and the weight, which is 1
    colours = 1 if image.shape[2] == 1 else min(3, image.shape[2])
    has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
    index = dr.arange(mi.UInt32, height * width * channels)
    channel, pixel = index % channels, index // channels
    value = dr.gather(mi.Float, image.array, pixel * image.shape[2] + dr.minimum(channel, colours - 1))
    value = dr.select(channel < channels - 1 - has_alpha, value, 1)
    tensor: Any = mi.TensorXf(value, (height, width, channels))
    film.put_block(mi.ImageBlock(tensor, film.crop_offset()))


create = LingoXray
