"""Measure a hard case: its image and derivatives on the device against float64 on the same float32 input.

Errors are relative. The image's error is its root mean square deviation over its root mean square. The loss is a sum of the
image with normal weights. The errors of derivatives are taken Gaussian by Gaussian, and the largest counts. Each derivative is
first converted to the loss's unit, by a factor:

- `scale`: the scale, so that a needle's length counts as much as its width
- `centre`: the smallest standard deviation, a natural distance to move
- `quaternion`: its length times the smallest over the largest standard deviation, a natural angle to turn
- `density`: the density

The error of each kind is divided by the norm of all of the Gaussian's derivatives, since one kind alone may cancel by chance. If
these derivatives, or a whole image, are below FLOOR times the integral through a Gaussian's thinnest part (for example, if only
its far tail reaches into the view), that is the reference instead.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import erf

from lingo_mi.common.errors import AccuracyWarning, InputError
from lingo_mi.geometry.rays import Rays
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.view import View, vector64
from lingo_mi.projectors.voxelize import Lattice, voxelize
from lingo_mi.validation import oracle
from lingo_mi.validation.closed_form import NAMES, rays_and_gradients
from lingo_mi.validation.oracle import Cloud, Pose
from studies.hard_cases.kinds import ScanCase, ViewCase, VoxelCase

PARAMETERS = tuple(NAMES)
EXTENT = 8.0  # leaves e^-32 of a Gaussian out, 1e-14
FLOOR = 1e-6
TINY = 1e-30
MOST_COMPARED = 100
# What approximate instructions of a GPU add, as a share of the bounds: rsqrt.approx errs by 2^-22.9 and ex2.approx by 2^-22 (PTX
# ISA, 9.7.3). The root is squared into an exponent that is 1 on average, so that the image errs by 3 * 2^-22.9 + 2^-22 = 6e-7
# more. Sums for derivatives amplify this as they do rounding.
APPROXIMATE = 0.6


@dataclass(frozen=True)
class Result:
    """Outcome of a case.

    Parameters
    ----------
    image : float or None
        Relative error of the image or of the densities; None if nothing is compared.
    gradients : dict[str, float]
        Relative errors of the derivatives by name.
    refused : str
        The message that refused it.
    warned : str
        The first warning.
    failed : str
        Faults of the result, apart from its errors.
    """

    image: float | None = None
    gradients: dict[str, float] = field(default_factory=dict)
    refused: str = ''
    warned: str = ''
    failed: str = ''


def on_device(cloud: Cloud) -> tuple[mi.Point3f, mi.Vector3f, mi.Vector4f, mi.Float]:
    """Centre, scale, rotation and density as opaque Dr.Jit arrays."""

    # From lists, because Dr.Jit compiles the alignment of a NumPy buffer into its kernels; that takes seconds a case.
    def column(values):
        return mi.Float(values.tolist() if len(values) < 1000 else values.astype(np.float32))

    arrays = (
        mi.Point3f(*map(column, cloud.centre.T)),
        mi.Vector3f(*map(column, cloud.scale.T)),
        mi.Vector4f(*map(column, cloud.rotation.T)),
        column(cloud.density),
    )
    dr.make_opaque(arrays)
    return arrays


def host(value: Any) -> Any:
    """A Dr.Jit array as NumPy [N, ...]."""
    array = np.array(value, float)
    return array.T if array.ndim > 1 else array


def image_and_gradients(
    cloud: Cloud, rays: Rays, shape: tuple[int, int], weights: np.ndarray, extent: float = EXTENT
) -> tuple[np.ndarray, dict[str, Any]]:
    """The device's image of a cloud in the first view of `rays`, float64 [pixels], and derivatives of sum(weights * image) by
    name.

    Parameters
    ----------
    shape : tuple[int, int]
        Shape of the image, (v, u).
    weights : ndarray [pixels]
    extent : float
        Cut-off in standard deviations.
    """
    view, gaussians = View.of(rays, 0, shape[0], shape[1]), on_device(cloud)
    dr.enable_grad(gaussians)
    image = line_integrals(*gaussians, view, RenderOptions(extent))
    dr.backward(dr.sum(image * mi.Float(weights.tolist())))
    return image.numpy().astype(float), {n: host(dr.grad(x)) for n, x in zip(PARAMETERS, gaussians)}


def weights_of(shape: tuple[int, int]) -> np.ndarray:
    """The weights of the loss, normal about zero, [pixels]."""
    return np.float32(np.random.default_rng(0).normal(size=shape[0] * shape[1])).astype(float)


def natural(cloud: Cloud, gradients: dict[str, Any]) -> dict[str, Any]:
    """Derivatives in the units that the module's docstring explains, [N, components] by name."""
    low, high = cloud.scale.min(1), cloud.scale.max(1)
    turn = np.linalg.norm(cloud.rotation, axis=1) * low / high
    return dict(
        centre=gradients['centre'] * low[:, None],
        scale=gradients['scale'] * cloud.scale,
        rotation=gradients['rotation'] * turn[:, None],
        density=(gradients['density'] * cloud.density)[:, None],
    )


def errors(
    cloud: Cloud,
    image: np.ndarray,
    gradients: dict,
    expected: np.ndarray,
    expected_gradients: dict,
    thickness: Any = None,
) -> Result:
    """Errors of an image and of derivatives, as the module's docstring counts them.

    Parameters
    ----------
    expected, expected_gradients
        The same in float64.
    thickness
        [N], the largest integral through each Gaussian if its density were 1; None: along its shortest axis.
    """
    thickness = np.sqrt(2 * np.pi) * cloud.scale.min(1) if thickness is None else thickness
    floor = FLOOR * np.abs(cloud.density) * thickness + TINY
    derivatives, truth = natural(cloud, gradients), natural(cloud, expected_gradients)
    size = np.maximum(np.linalg.norm(np.concatenate(list(truth.values()), 1), axis=1), floor)
    worst = {name: float((np.linalg.norm(derivatives[name] - truth[name], axis=1) / size).max()) for name in PARAMETERS}
    norm = max(np.linalg.norm(expected), floor.max())
    return Result(float(np.linalg.norm(image - expected) / norm), worst)


def measure(case: ViewCase | VoxelCase | ScanCase) -> Result:
    """The errors of a case, or the message that refuses it."""
    kind = {ViewCase: _measure_view, VoxelCase: _measure_voxels, ScanCase: _measure_scan}[type(case)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always', AccuracyWarning)
        try:
            result = kind(case)
        except InputError as error:
            result = Result(refused=str(error))
        except FloatingPointError as error:
            result = Result(failed=str(error))
    messages = [str(w.message) for w in caught if issubclass(w.category, AccuracyWarning)]
    return replace(result, warned=messages[0] if messages else '')


def _measure_view(case):
    weights, pose = weights_of(case.shape), Pose.of(case.rays, 0, *case.shape)
    many = case.cloud[np.tile(np.arange(len(case.cloud)), case.copies)] if case.copies > 1 else case.cloud
    image, gradients = image_and_gradients(many, case.rays, case.shape, weights)
    expected, few = _expected_image(case.cloud, pose)
    gradients = {name: g[few] for name, g in gradients.items()}
    cloud = case.cloud[few]
    if case.analytic:
        _, truth = rays_and_gradients([getattr(cloud, name) for name in PARAMETERS], *pose.rays(), weights)
    else:
        truth = oracle.gradients(cloud, pose, weights)
    return errors(cloud, image, gradients, case.copies * expected, truth)


def _expected_image(cloud, pose):
    """`oracle.line_integrals`, for large clouds a ray at a time, and the Gaussians whose derivatives are to be compared: as
    those do not depend on the others, of a large cloud the MOST_COMPARED that give most to the image."""
    if len(cloud) <= MOST_COMPARED:
        return oracle.line_integrals(cloud, pose), np.arange(len(cloud))
    total = np.zeros(len(cloud))
    turn = Rotation.from_quat(cloud.rotation).inv()
    out = []
    for start, direction in zip(*pose.rays()):
        w, d = turn.apply(cloud.centre - start) / cloud.scale, turn.apply(direction) / cloud.scale
        dd = (d * d).sum(1)
        m = (w * d).sum(1) / dd
        share = 0.5 * (1 - erf((pose.begin - m) * np.sqrt(dd / 2)))
        peak = cloud.density * np.sqrt(2 * np.pi / dd) * np.linalg.norm(direction)
        each = peak * np.exp(-0.5 * ((w - m[:, None] * d) ** 2).sum(1)) * share
        out.append(each.sum())
        total += each
    return np.array(out), np.argsort(-total)[:MOST_COMPARED]


def _measure_voxels(case):
    nx, ny, nz = case.shape
    z, y, x = np.indices((nz, ny, nx))
    points = case.corner + (np.stack([x, y, z], -1).reshape(-1, 3) + 0.5) * case.step
    weights, gaussians = weights_of((nz * ny, nx)), on_device(case.cloud)
    dr.enable_grad(gaussians)
    density = voxelize(*gaussians, Lattice(vector64(case.corner), vector64(case.step), case.shape), EXTENT)
    dr.backward(dr.sum(density * mi.Float(weights.tolist())))
    gradients = {n: host(dr.grad(x)) for n, x in zip(PARAMETERS, gaussians)}
    return errors(
        case.cloud,
        density.numpy().astype(float),
        gradients,
        oracle.values_at(case.cloud, points),
        oracle.value_gradients(case.cloud, points, weights),
        np.ones(len(case.cloud)),
    )


def _measure_scan(case):
    case.act()
    return Result()


def miss(case: ViewCase | VoxelCase | ScanCase, result: Result, variant: str) -> str:
    """Describe in words the faults of a case. The text is empty if the case is within its tolerances, or was refused or warned
    of as it should be.

    Parameters
    ----------
    variant : str
        Mitsuba's, that it was measured with.
    """
    refused = case.refused if isinstance(case, ScanCase) else ''
    if result.failed:
        return result.failed
    if bool(result.warned) != case.warned:
        return f'warned: {result.warned!r}' if result.warned else 'not warned of'
    if result.refused if not refused else refused not in result.refused:
        return f'refused: {result.refused!r}' if result.refused else 'not refused'
    if isinstance(case, ScanCase):
        return ''
    factor = 1 + APPROXIMATE if variant.startswith('cuda') else 1
    if result.image is None or not result.image <= factor * case.image:
        return f'error of the image {result.image:.1e}, at most {factor * case.image:.2g}'
    worst = max(result.gradients.values())
    if not worst <= factor * case.gradient:
        return f'error of a derivative {worst:.1e}, at most {factor * case.gradient:.2g}'
    return ''
