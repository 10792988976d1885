r"""Scattered photons: Mitsuba's volume path tracer on a coarse grid of the panel, smoothed (Dr.Jit and NumPy).

The signal of a panel is the photons that cross its surface. At a point x of the panel, the scattered signal relative to the
open beam I0 is

    S(x) = 1 / I0(x)  \int L(x, w) cos(w, n) dw,    I0(x) = cos(x - s, n) / |x - s|^2

for a source s of intensity 1. L is the radiance that arrives from direction w. `volpath` computes it in the collimated beam of
the view (`ct_beam`), after one or more scatterings, with the tables of `compton` as phase functions. Directions point to
samples distributed uniformly in the box of the objects: a lattice with a random shift in each of BATCHES batches. The spread of
the batches gives the error of a mean. A smoothing spline with residuals of that size interpolates the means at the pixels.

Scattered photons are attenuated at their initial energy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import uniform_filter

from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import MOST_SEED
from lingo_mi.effects.compton import scattering
from lingo_mi.effects.hardening import Tube, by_material
from lingo_mi.effects.spectrum import attenuation
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.objects import GridInCube
from lingo_mi.projectors.sampling import bounds, on_grid
from lingo_mi.projectors.view import View

BATCHES = 16
MOST_LANES = 2**22  # paths per launch: a few hundred megabytes
LEAST_GRID, MOST_GRID = 4, 256  # a bicubic spline needs four points
MOST_TOGETHER = 2**29  # rows x columns of the grid x paths: some gigabytes at once
MOST_PATHS, MOST_VOXELS, MOST_ENERGIES, MOST_ORDERS = 2**20, 512, 16, 1000
_LATTICE = [int(2**32 / 1.2207440846057596**k) for k in (1, 2, 3)]  # powers of the root of x^4 = x + 1 (Roberts)


@dataclass(frozen=True)
class Scatter:
    """See the `scatter` parameters of the emitter `xray_tube`."""

    paths: int
    grid: tuple[int, int] = (16, 16)
    orders: int = -1
    voxels: int = 64
    energies: int = 3
    seed: int = 0
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    @staticmethod
    def of(paths: Any, grid: Any, orders: Any, voxels: Any, energies: Any, seed: Any, box: Any) -> Scatter | None:
        """From plugin parameters; None without paths. Raises InputError."""
        for name, value, least, most in (
            ('scatter', paths, 0, MOST_PATHS),
            ('scatter_orders', orders, -1, MOST_ORDERS),
            ('scatter_voxels', voxels, 1, MOST_VOXELS),
            ('scatter_energies', energies, 1, MOST_ENERGIES),
            ('scatter_seed', seed, 0, MOST_SEED),
        ):
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise InputError(f'{name} must be a whole number from {least} to {most}, not {value!r}')
        if orders == 0:
            raise InputError('scatter_orders must be positive, or -1 for any number of scatterings')
        try:
            numbers = [int(x) for x in str(grid).replace(',', ' ').split()]
        except ValueError:
            numbers = []
        if len(numbers) not in (1, 2) or not all(LEAST_GRID <= x <= MOST_GRID for x in numbers):
            raise InputError(
                f'scatter_grid must be one or two whole numbers from {LEAST_GRID} to {MOST_GRID}, rows and '
                f'columns, not {grid!r}'
            )
        if numbers[0] * numbers[-1] * paths > MOST_TOGETHER:
            raise InputError(
                f'scatter: {paths} paths to each of {numbers[0]} x {numbers[-1]} points take too much memory: '
                f'give at most {MOST_TOGETHER // (numbers[0] * numbers[-1])} paths, or a smaller scatter_grid'
            )
        return (
            Scatter(paths, (numbers[0], numbers[-1]), orders, voxels, energies, seed, _corners(box)) if paths else None
        )

    def within(self, geometry: Geometry) -> Scatter:
        """The same, but nothing scatters outside a geometry's volume.

        Raises
        ------
        InputError
            If the two boxes do not meet.
        """
        low, high = geometry.grid.low, geometry.grid.high
        if self.box is not None:
            low, high = np.maximum(low, self.box[0]), np.minimum(high, self.box[1])
        if not (low < high).all():
            raise InputError('scatter_box lies outside the volume: nothing would scatter')
        return replace(self, box=(tuple(low.tolist()), tuple(high.tolist())))

    @property
    def parameters(self) -> dict:
        """The parameters of `xray_tube` that make it."""
        box = {} if self.box is None else dict(scatter_box=', '.join(repr(x) for corner in self.box for x in corner))
        return (
            dict(
                scatter=self.paths,
                scatter_grid='{}, {}'.format(*self.grid),
                scatter_orders=self.orders,
                scatter_voxels=self.voxels,
                scatter_energies=self.energies,
                scatter_seed=self.seed,
            )
            | box
        )

    def light(self, objects: list, tube: Tube, response: str, view: View, index: int) -> Any:
        """Scattered signal, relative to the open beam's, at a view's pixel centres, Float [height * width]. Not differentiable.

        Parameters
        ----------
        objects : list
            Objects, as `projectors.objects.find_objects` gives them.
        tube : Tube
            `hardening.Tube` with the objects' materials.
        response : str
            'energy' or 'count'.
        index : int
            Key of the random numbers, together with `seed`.

        Raises
        ------
        InputError
            If an object has no material or reaches the panel.
        """
        means, errors = self.estimate(objects, tube, response, view, index)
        return mi.Float(smoothed(means, errors, view.height, view.width).astype(np.float32).ravel())

    def estimate(
        self, objects: list, tube: Tube, response: str, view: View, index: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """`light` on the coarse grid, from edge to edge of the panel: means and standard errors, float64 [rows, columns]."""
        with dr.suspend_grad():
            key, sources = (response, self.voxels, self.energies, self.box), (tube, *objects)
            if not (
                _LATEST
                and key == _LATEST[0]
                and len(sources) == len(_LATEST[1])
                and all(a is b for a, b in zip(sources, _LATEST[1]))
            ):
                _LATEST[:] = key, sources, _scenes(objects, tube, response, self.voxels, self.energies, self.box)
            low, high, beam, scenes = _LATEST[2]
            beam.aim(view, 2 * float(np.linalg.norm(high - low)))
            rays = _Rays(view, self.grid, -(-self.paths // BATCHES), low, high)
            integrator = mi.load_dict(dict(type='volpath', max_depth=self.orders + 1 if self.orders > 0 else -1))
            rng = np.random.Generator(np.random.Philox(key=[self.seed, index]))
            total = np.zeros((*self.grid, BATCHES))
            for weight, scene in scenes:
                for first in range(0, BATCHES, rays.batches):
                    total[..., first : first + rays.batches] += weight * rays.means(integrator, scene, rng)
            return total.mean(-1), total.std(-1, ddof=1) / np.sqrt(BATCHES)


_LATEST: list = []  # cache of the last scenes and their objects, for all views of a scan


def _corners(text):
    """Two corners from a plugin's parameter, None from an empty one."""
    if text == '':
        return None
    try:
        numbers = [float(x) for x in str(text).replace(',', ' ').split()]
    except ValueError:
        numbers = []
    if not (len(numbers) == 6 and np.isfinite(numbers).all() and all(a < b for a, b in zip(numbers, numbers[3:]))):
        raise InputError(f'scatter_box must be x, y, z of its lowest and of its highest corner, mm, not {text!r}')
    return tuple(numbers[:3]), tuple(numbers[3:])


def smoothed(means: np.ndarray, errors: np.ndarray, height: int, width: int) -> np.ndarray:
    """A bicubic smoothing spline at the pixel centres, [height, width], not negative.

    Parameters
    ----------
    means, errors : ndarray [rows, columns]
        At equal steps from edge to edge of the panel; the spline's squared residuals sum to the squared errors (Dierckx, "Curve
        and Surface Fitting with Splines", 1993, ch. 5).
    """
    rows, columns = (np.linspace(0, size, n) for n, size in zip(means.shape, (height, width)))
    residual: Any = float((errors**2).sum())  # SciPy declares a whole number
    spline = RectBivariateSpline(rows, columns, means, s=residual)
    return np.maximum(spline(np.arange(height) + 0.5, np.arange(width) + 0.5), 0)


# ----------------------------------------------------------------------------------------------------------------------
#  The scene
# ----------------------------------------------------------------------------------------------------------------------


def _scenes(objects, tube, response, voxels, energies, box):
    """The box of the objects, the beam, and (weight, scene) for every energy; no scenes if nothing attenuates."""
    low, high = bounds(objects) if box is None else np.array(box)
    if len(objects) == 1 and isinstance(objects[0], GridInCube) and box is None:
        shape = tuple(objects[0].size)
    else:
        step = (high - low).max() / voxels
        shape = tuple(np.maximum(1, np.ceil((high - low) / step - 1e-6)).astype(int).tolist())
    step = (high - low) / shape
    densities = {
        name: np.maximum(sum(on_grid(obj, low, step, shape) for obj in members), 0)
        for name, members in by_material(objects, tube).items()
    }
    beam = mi.load_dict(dict(type='ct_beam'))
    if not any(d.any() for d in densities.values()):
        return low, high, beam, []
    return (
        low,
        high,
        beam,
        [
            (
                weight,
                mi.load_dict(
                    dict(
                        type='scene',
                        beam=beam,
                        box=_box(low, high, _medium(densities, tube.reference, energy, response, low, high)),
                    )
                ),
            )
            for weight, energy in _energies(tube.spectrum.energies, tube.spectrum.detected(response), energies)
        ],
    )


def _energies(energies, shares, count):
    """(weight, energy) of parts of a spectrum with equal signal; a part's energy is its mean."""
    parts = np.minimum((np.cumsum(shares) - shares / 2) * count, count - 1e-9).astype(int)
    weights = np.bincount(parts, shares)
    means = np.bincount(parts, shares * energies)
    return [(float(w), float(m / w)) for w, m in zip(weights, means) if w > 0]


def _medium(densities, reference, energy, response, low, high):
    """The medium of materials whose densities, float32 [x, y, z], are attenuation at the reference energy."""
    attenuating: Any = 0.0
    scattered = []
    for name, density in densities.items():
        amount = density / attenuation(name, [reference])[0]
        attenuating = attenuating + amount * attenuation(name, [energy])[0]
        scattered.append(amount * scattering(energy, name, response)[1])
    names = list(densities)
    phase, so_far = _phase(names[0], energy, response), scattered[0]
    for name, more in zip(names[1:], scattered[1:]):
        so_far = so_far + more
        phase = dict(
            type='blendphase',
            weight=_volume(_ratio(more, so_far), low, high),
            phase_0=phase,
            phase_1=_phase(name, energy, response),
        )
    albedo = (
        _volume(_ratio(so_far, attenuating), low, high) if len(names) > 1 else float(so_far.sum() / attenuating.sum())
    )
    return dict(
        type='heterogeneous',
        sigma_t=_volume(attenuating, low, high),
        albedo=albedo,
        phase=phase,
        has_spectral_extinction=False,
    )


def _phase(name, energy, response):
    return dict(type='klein_nishina', energy=energy, material=name, response=response)


def _ratio(part, whole):
    """part / whole; in empty voxels the value of their neighbours, because it is interpolated between voxels."""
    near, around = uniform_filter(part, 3), uniform_filter(whole, 3)
    near = np.divide(near, around, out=np.zeros_like(near), where=around > 0)
    return np.divide(part, whole, out=near, where=whole > 0)


def _volume(values, low, high):
    grid = mi.VolumeGrid(np.ascontiguousarray(values.transpose(2, 1, 0), np.float32)[..., None])
    where = mi.ScalarTransform4f().translate(low.tolist()).scale((high - low).tolist())
    return dict(type='gridvolume', grid=grid, to_world=where, raw=True, wrap_mode='clamp')


def _box(low, high, medium):
    where = mi.ScalarTransform4f().translate(((low + high) / 2).tolist()).scale(((high - low) / 2).tolist())
    return dict(type='cube', to_world=where, bsdf=dict(type='null'), interior=medium)


# ----------------------------------------------------------------------------------------------------------------------
#  The rays
# ----------------------------------------------------------------------------------------------------------------------


class _Rays:
    """Rays from a coarse grid of points on the panel to points in a box, in batches that fit into memory."""

    def __init__(self, view: View, grid: tuple[int, int], count: int, low: np.ndarray, high: np.ndarray):
        self.grid, self.count, self.batches = grid, count, BATCHES
        while self.batches > 1 and grid[0] * grid[1] * self.batches * count > MOST_LANES:
            self.batches //= 2
        columns = dr.opaque(mi.UInt32, grid[1])
        self.shifted = dr.arange(mi.UInt32, grid[0] * grid[1] * self.batches * count) // dr.opaque(mi.UInt32, count)
        point = self.shifted // dr.opaque(mi.UInt32, self.batches)
        self.low: Any = dr.opaque(mi.Point3f, low.tolist())
        self.extent: Any = dr.opaque(mi.Vector3f, (high - low).tolist())
        Vector3f: Any = mi.Vector3f
        source, corner, u, v = (Vector3f(a) for a in (view.source, view.corner, view.u, view.v))
        x = mi.Float(point % columns) * dr.opaque(mi.Float, view.width / (grid[1] - 1))
        y = mi.Float(point // columns) * dr.opaque(mi.Float, view.height / (grid[0] - 1))
        self.origin: Any = mi.Point3f(corner + x * u + y * v)
        beam = source if view.parallel else self.origin - source
        across: Any = dr.normalize(dr.cross(u, v))
        self.normal: Any = dr.select(dr.dot(across, beam) < 0, across, -across)  # towards the source
        along: Any = dr.abs(dr.dot(self.normal, beam))
        self.open = along / (1 if view.parallel else dr.norm(beam) ** 3)
        corners = (mi.Point3f(self.low + self.extent * mi.Vector3f(i & 1, i >> 1 & 1, i >> 2)) for i in range(8))
        height = [dr.dot(self.normal, p - self.origin) for p in corners]
        nearest = height[0]
        for h in height[1:]:
            nearest = dr.minimum(nearest, h)
        if dr.any(nearest <= 0):
            raise InputError(
                'scatter: the box of the objects reaches the panel; move the panel, or give a smaller scatter_box'
            )
        dr.eval(self.shifted, self.origin, self.normal, self.open)

    def means(self, integrator: Any, scene: Any, rng: np.random.Generator) -> np.ndarray:
        """Scattered signal, relative to the open beam's, float64 [rows, columns, batches]."""
        shape = *self.grid, self.batches
        sampler = mi.load_dict(dict(type='independent'))
        sampler.seed(dr.opaque(mi.UInt32, int(rng.integers(2**32))), dr.width(self.shifted))
        j = dr.arange(mi.UInt32, dr.width(self.shifted)) - self.shifted * dr.opaque(mi.UInt32, self.count)
        shift = [mi.UInt32(s) for s in rng.integers(2**32, size=(3, np.prod(shape)), dtype=np.uint32)]
        xi = mi.Vector3f(
            *(mi.Float((j * a + dr.gather(mi.UInt32, s, self.shifted)) >> 8) * 2**-24 for a, s in zip(_LATTICE, shift))
        )
        direction = dr.normalize(self.low + xi * self.extent - self.origin)
        # For uniform points in the box, the density of a direction is (far^3 - near^3) / 3 over the box's volume.
        a, b = (self.low - self.origin) / direction, (self.low + self.extent - self.origin) / direction
        near, far = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
        weight = 3 * dr.prod(self.extent) / ((far - near) * (far * far + far * near + near * near))
        light, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(mi.Ray3f(self.origin, direction)))
        value = light[0] * weight * dr.dot(self.normal, direction) / self.open
        return value.numpy().astype(float).reshape(*shape, self.count).mean(-1)
