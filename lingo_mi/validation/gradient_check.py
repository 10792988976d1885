"""The gradient check: derivatives of a scene's image by `lingo_xray`, against differences.

The function is L = sum(weights * image) with fixed random weights, normal about zero. Its derivatives by automatic
differentiation are compared with

- `ellipsoids`: central differences of the closed form in float64 NumPy, since differences of a float32 image are mostly
rounding; the
  cut-off is set to 8 standard deviations, because the closed form has none
- `grids`: the image of one voxel of density 1 in an empty grid, minus one of the empty grid: integrals are linear in a grid, so
  the only error of this large step is rounding

For a scene in transmission, I = exp(-p), both use dL = -sum(weights * I * dp).

    rows = check_gradients(load_scene_file('scene.xml'))
    print(gradient_table(rows))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.projectors.objects import find_objects
from lingo_mi.projectors.sensors import view_of
from lingo_mi.scene.load import load_file
from lingo_mi.validation.oracle import Pose, gaussian_integral

EXTENT = 8.0
COLUMNS = {'centre': slice(0, 3), 'scale': slice(3, 6), 'rotation': slice(6, 10)}  # of an ellipsoids' `data`
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Row:
    """One derivative.

    Parameters
    ----------
    parameter : str
        Its name.
    ad, fd : float
        Derivatives by automatic differentiation and by differences.
    error : float
        |ad - fd| over the length of the gradient that it is a component of: all of one kind's components of a Gaussian, or all
        voxels that were drawn.
    """

    parameter: str
    ad: float
    fd: float
    error: float


def load_scene_file(path: PathLike | str) -> Any:
    """Any Mitsuba scene, with or without a scanner. Raises InputError, in one line, for whatever Mitsuba finds wrong."""
    if not Path(path).is_file():
        raise InputError(f'{path}: there is no such file')
    return load_file(Path(path))


def check_gradients(scene: Any, step: float = 1e-4, count: int = 4, seed: int = 0) -> list[Row]:
    """Compare derivatives of a scene's image in its first sensor.

    Parameters
    ----------
    step : float
        Step of the differences for ellipsoids, in parts of a Gaussian's smallest standard deviation (of the number itself for
        densities).
    count : int
        Gaussians of every cloud and voxels of every grid to check, drawn with `seed` among those in view.

    Raises
    ------
    InputError
        If the integrator is not `lingo_xray`, or the scene has neither ellipsoids nor grids in view.
    """
    integrator = scene.integrator()
    if not str(integrator).startswith('LingoXray'):
        raise InputError('the scene must have the integrator lingo_xray')
    if not scene.sensors():
        raise InputError('the scene has no sensor')
    if count < 1 or not 0 < step < 0.1:
        raise InputError(f'count must be at least 1 and step between 0 and 0.1, not {count} and {step:g}')
    find_objects(scene)  # refuses what cannot be rendered
    transmission, rng = integrator.output == 'transmission', np.random.default_rng(seed)
    line = mi.load_dict(dict(type='lingo_xray', extent=EXTENT))
    exact = mi.load_dict(dict(type='lingo_xray', extent=EXTENT, output=integrator.output))
    rendered = line.render(scene)
    weights = rng.normal(size=rendered.shape).astype(np.float32)

    params = mi.traverse(scene)
    clouds = [k.removesuffix('.density') for k in params.keys() if k.endswith('.density')]  # noqa: SIM118 - no dict
    clouds = [name for name in clouds if f'{name}.data' in params]
    grids = [k for k in params.keys() if k.endswith('sigma_t.data')]  # noqa: SIM118
    keys = [f'{name}.{part}' for name in clouds for part in ('data', 'density')] + grids
    if not keys:
        raise InputError('the scene has neither ellipsoids nor grids: there is no derivative to check')
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, integrator=exact) * mi.TensorXf(weights), axis=None))
    gradients = {key: np.array(dr.grad(params[key]), float) for key in keys}
    for key in keys:
        dr.disable_grad(params[key])
    params.update()

    slope = weights.sum(-1, dtype=float).ravel()
    if transmission:
        slope = -slope * np.exp(-np.array(rendered, float)[..., 0].ravel())
    view = view_of(scene.sensors()[0])
    pose = Pose.of_view(view)
    rays = *pose.rays(), pose.begin

    def loss(values):
        """Compute the loss of one Gaussian alone, (centre, scale, quaternion, density)."""
        return slope @ gaussian_integral((values[:3], values[3:6], values[6:10], values[10]), *rays)

    def image():
        return np.array(line.render(scene), float)[..., 0].ravel()

    rows = []
    for name in clouds:
        drawn = _draw(gradients[f'{name}.density'], count, rng)
        rows += _of_cloud(name, params, gradients, drawn, loss, step)
    for key in grids:
        drawn = _draw(gradients[key].ravel(), count, rng)
        rows += _of_grid(key, params, gradients[key], drawn, image, slope)
    if not rows:
        raise InputError('the image shows neither ellipsoids nor grids: there is no derivative to check')
    return rows


def gradient_table(rows: list[Row]) -> str:
    """The rows as text, one a line."""
    width = max(len(row.parameter) for row in rows)
    lines = [f'{"parameter":{width}s} {"AD":>14s} {"differences":>14s} {"error":>9s}']
    lines += [f'{r.parameter:{width}s} {r.ad:14.6e} {r.fd:14.6e} {r.error:9.1e}' for r in rows]
    return '\n'.join(lines)


def _draw(gradient, count, rng):
    """Indices of up to `count` parameters that the image shows."""
    return np.sort(rng.permutation(np.flatnonzero(gradient))[:count])


def _of_cloud(name: str, params, gradients: dict, drawn, loss: Callable, step: float) -> list[Row]:
    """The derivatives of the drawn Gaussians of a cloud, by differences of a Gaussian's `loss`."""
    data = np.array(params[f'{name}.data'], float).reshape(-1, 10)
    density = np.array(params[f'{name}.density'], float)
    by_data, by_density = gradients[f'{name}.data'].reshape(-1, 10), gradients[f'{name}.density']
    rows = []
    for i in drawn:
        values = np.append(data[i], density[i])
        size = np.append(np.full(6, data[i, 3:6].min()), np.full(4, np.linalg.norm(data[i, 6:])))
        size = step * np.append(size, max(abs(density[i]), 1.0))
        fd = np.array([(loss(values + h) - loss(values - h)) / (2 * h.sum()) for h in np.diag(size)])
        ad = np.append(by_data[i], by_density[i])
        for kind, columns in (*COLUMNS.items(), ('density', slice(10, 11))):
            names = [f'{name}.{kind}[{i}]' + f'.{c}' * (kind != 'density') for c in 'xyzw']
            rows += _compare(ad[columns], fd[columns], names)
    return rows


def _of_grid(key: str, params, gradient, drawn, image: Callable, slope) -> list[Row]:
    """The derivatives of the drawn voxels of a grid, by differences of the scene's `image` [pixels]."""
    tensor = mi.TensorXf(params[key])  # a copy: setting a parameter overwrites the object in place
    flat = gradient.ravel()

    def image_of(values):
        params[key] = mi.TensorXf(values, tensor.shape)
        params.update()
        return image()

    try:
        # Images are subtracted before they are summed: pixels that the voxel does not reach cancel to the last bit.
        unit = np.eye(1, len(flat), dtype=np.float32)[0]
        empty = image_of(0 * unit)
        fd = [slope @ (image_of(np.roll(unit, i)) - empty) for i in drawn]
    finally:
        params[key] = tensor
        params.update()
    names = ('[' + ', '.join(str(j) for j in np.unravel_index(i, tensor.shape)[2::-1]) + ']' for i in drawn)
    return _compare(flat[drawn], np.array(fd), [key + name for name in names])


def _compare(ad, fd, names) -> list[Row]:
    length = max(np.linalg.norm(fd), np.linalg.norm(ad), np.finfo(float).tiny)
    return [Row(name, a, b, abs(a - b) / length) for name, a, b in zip(names, ad, fd)]
