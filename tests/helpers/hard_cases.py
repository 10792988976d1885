"""Hard cases: clouds, views, grids and scans where float32 is pressed, with the error that each may show.

`cases()` lists them all; `measure` compares one with the float64 oracle on the same float32 input, or tells how it
was refused or warned of; `markdown` makes a table. Errors are relative. That of the image is the root mean square
deviation over that of the image. Those of derivatives are taken Gaussian by Gaussian, and the worst counts. For that
each is made a number of the loss's unit: that by a scale is multiplied by the scale, so that a needle's length counts
as much as its width; that by the centre by the smallest standard deviation, over which the Gaussian may move; that by
the quaternion by its length and the ratio of the smallest to the largest standard deviation, over which it may turn;
that by the density by the density. The loss is a sum of the image with normal weights. What counts is the error of
each kind over the length of all of the Gaussian's derivatives, since one kind alone may cancel by chance. Where
these, or a whole image, are below FLOOR of the integral through a Gaussian's thinnest part (only its far tail reaches
into the view, say) they are compared with that.
"""

import warnings
from dataclasses import dataclass, field, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import erf

from helpers import oracle
from helpers.oracle import Cloud, Pose, random_cloud
from lingo_mi.errors import AccuracyWarning, InputError
from lingo_mi.fit.loop import run as fit
from lingo_mi.fit.settings import FAST
from lingo_mi.fit.state import activate
from lingo_mi.geometry.base import Geometry, circular
from lingo_mi.geometry.rays import Rays
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.view import View, vector64
from lingo_mi.projectors.voxelize import Grid, voxelize
from lingo_mi.scan import Scan
from lingo_mi.studies.closed_form import rays_and_gradients

PARAMETERS = 'centre', 'scale', 'rotation', 'density'
EXTENT = 8.0  # leaves e^-32 of a Gaussian out, 1e-14
FLOOR = 1e-6
TINY = 1e-30
MOST_COMPARED = 100

IMAGE, GRADIENT = 1e-6, 1e-5  # what a case may show unless it says otherwise


@dataclass(frozen=True)
class Case:
    """A cloud in one view.

    image, gradient   largest errors allowed
    panel             whether integrals end at the panel
    copies            how often the cloud is there, at the same place
    warned            whether an AccuracyWarning must come with it
    analytic          whether derivatives are compared with those of `closed_form`, since differences of the oracle's float64
                      are too coarse; only for Gaussians far from the ends of the rays
    note              what limits the accuracy, where it is less than usual
    """

    name: str
    cloud: Cloud
    frames: Rays
    shape: tuple
    image: float = IMAGE
    gradient: float = GRADIENT
    panel: bool = True
    copies: int = 1
    warned: bool = False
    analytic: bool = False
    note: str = ''


@dataclass(frozen=True)
class VoxelCase:
    """A cloud on a grid of voxels. The errors are those of the densities at the voxels' centres."""

    name: str
    cloud: Cloud
    corner: np.ndarray
    step: np.ndarray
    shape: tuple
    image: float = IMAGE
    gradient: float = GRADIENT
    warned: bool = False
    note: str = ''


@dataclass(frozen=True)
class ScanCase:
    """Something done with a scan or a scene: `act()` must be refused with words of `refused`, or end well.

    warned   whether an AccuracyWarning must come with it
    """

    name: str
    act: object
    refused: str = ''
    warned: bool = False
    note: str = ''


@dataclass(frozen=True)
class Result:
    """What became of a case: errors (None where nothing is compared), the message that refused it, the warning."""

    image: float | None = None
    gradients: dict = field(default_factory=dict)
    refused: str = ''
    warned: str = ''


def scanner(mode='cone', shape=(24, 32), angle=33.0, size=(3.2, 3.0), **changes):
    """Rays of one view of a scanner around [-1, 1]^3, and the panel's shape."""
    pixel = [s / n for s, n in zip(size, shape)]
    settings = dict(
        DSO=5.0, DSD=7.5, nDetector=shape, dDetector=pixel, nVoxel=8, dVoxel=0.25, angles=np.radians([angle])
    )
    return Geometry(**{**settings, 'mode': mode, **changes}).rays(), shape


def on_device(cloud):
    # From lists, because Dr.Jit compiles the alignment of a NumPy buffer into its kernels; that takes seconds a test.
    def column(values):
        return mi.Float(values.tolist() if len(values) < 1000 else np.float32(values))

    arrays = (
        mi.Point3f(*map(column, cloud.centre.T)),
        mi.Vector3f(*map(column, cloud.scale.T)),
        mi.Vector4f(*map(column, cloud.rotation.T)),
        column(cloud.density),
    )
    dr.make_opaque(arrays)
    return arrays


def host(value):
    """A Dr.Jit array as NumPy [N, ...]."""
    array = np.array(value, float)
    return array.T if array.ndim > 1 else array


def run(cloud, frames, shape, weights, panel=True, extent=EXTENT):
    """Image, and derivatives of sum(weights * image) by the cloud."""
    view, gaussians = View.of(frames, 0, *shape, panel), on_device(cloud)
    dr.enable_grad(gaussians)
    image = line_integrals(*gaussians, view, RenderOptions(extent))
    dr.backward(dr.sum(image * mi.Float(weights.tolist())))
    return image.numpy().astype(float), {n: host(dr.grad(x)) for n, x in zip(PARAMETERS, gaussians)}


def weights_of(shape):
    return np.float32(np.random.default_rng(0).normal(size=shape[0] * shape[1])).astype(float)


def natural(cloud, gradients):
    """Derivatives in the units that the module's docstring explains, [N, components] by name."""
    low, high = cloud.scale.min(1), cloud.scale.max(1)
    turn = np.linalg.norm(cloud.rotation, axis=1) * low / high
    return dict(
        centre=gradients['centre'] * low[:, None],
        scale=gradients['scale'] * cloud.scale,
        rotation=gradients['rotation'] * turn[:, None],
        density=(gradients['density'] * cloud.density)[:, None],
    )


def errors(cloud, image, gradients, expected, expected_gradients, thickness=None) -> Result:
    """Compare an image and gradients with the oracle's. thickness [N]: integral through a Gaussian of density 1."""
    thickness = np.sqrt(2 * np.pi) * cloud.scale.min(1) if thickness is None else thickness
    floor = FLOOR * np.abs(cloud.density) * thickness + TINY
    found, truth = natural(cloud, gradients), natural(cloud, expected_gradients)
    size = np.maximum(np.linalg.norm(np.concatenate(list(truth.values()), 1), axis=1), floor)
    worst = {name: float((np.linalg.norm(found[name] - truth[name], axis=1) / size).max()) for name in PARAMETERS}
    norm = max(np.linalg.norm(expected), floor.max())
    return Result(float(np.linalg.norm(image - expected) / norm), worst)


def measure(case) -> Result:
    """The errors of a case, or the message that refuses it."""
    kind = {Case: _measure_view, VoxelCase: _measure_voxels, ScanCase: _measure_scan}[type(case)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always', AccuracyWarning)
        try:
            result = kind(case)
        except InputError as error:
            result = Result(refused=str(error))
    said = [str(w.message) for w in caught if issubclass(w.category, AccuracyWarning)]
    return replace(result, warned=said[0] if said else '')


def _measure_view(case):
    weights, pose = weights_of(case.shape), Pose.of(case.frames, 0, *case.shape)
    ends = (-np.inf, np.inf) if pose.parallel else (0.0, 1.0 if case.panel else np.inf)
    many = case.cloud[np.tile(np.arange(len(case.cloud)), case.copies)] if case.copies > 1 else case.cloud
    image, gradients = run(many, case.frames, case.shape, weights, case.panel)
    expected, few = image_of(case.cloud, pose, *ends)
    gradients = {name: g[few] for name, g in gradients.items()}
    cloud = case.cloud[few]
    if case.analytic:
        _, truth = rays_and_gradients([getattr(cloud, name) for name in PARAMETERS], *pose.rays(), weights)
    else:
        truth = oracle.gradients(cloud, pose, weights, *ends)
    return errors(cloud, image, gradients, case.copies * expected, truth)


def image_of(cloud, pose, *ends):
    """`oracle.line_integrals`, for large clouds a ray at a time, and the Gaussians of which derivatives are to be compared: as
    those do not depend on the others, of a large cloud the MOST_COMPARED that give most to the image."""
    if len(cloud) <= MOST_COMPARED:
        return oracle.line_integrals(cloud, pose, *ends), np.arange(len(cloud))
    given = np.zeros(len(cloud))
    turn = Rotation.from_quat(cloud.rotation).inv()
    out = []
    for start, direction in zip(*pose.rays()):
        w, d = turn.apply(cloud.centre - start) / cloud.scale, turn.apply(direction) / cloud.scale
        dd = (d * d).sum(1)
        m = (w * d).sum(1) / dd
        share = 0.5 * (erf((ends[1] - m) * np.sqrt(dd / 2)) - erf((ends[0] - m) * np.sqrt(dd / 2)))
        peak = cloud.density * np.sqrt(2 * np.pi / dd) * np.linalg.norm(direction)
        each = peak * np.exp(-0.5 * ((w - m[:, None] * d) ** 2).sum(1)) * share
        out.append(each.sum())
        given += each
    return np.array(out), np.argsort(-given)[:MOST_COMPARED]


def _measure_voxels(case):
    nx, ny, nz = case.shape
    z, y, x = np.indices((nz, ny, nx))
    points = case.corner + (np.stack([x, y, z], -1).reshape(-1, 3) + 0.5) * case.step
    weights, gaussians = weights_of((nz * ny, nx)), on_device(case.cloud)
    dr.enable_grad(gaussians)
    density = voxelize(*gaussians, Grid(vector64(case.corner), vector64(case.step), case.shape), EXTENT)
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


def check(case) -> Result:
    """Measure a case and assert that it is within its tolerances, or refused or warned of as it should be."""
    result = measure(case)
    assert bool(result.warned) == case.warned, result
    if isinstance(case, ScanCase):
        assert case.refused in result.refused if case.refused else not result.refused, result
        return result
    assert not result.refused and result.image <= case.image, result
    assert max(result.gradients.values()) <= case.gradient, result
    return result


def markdown(results) -> str:
    """A page with a table of cases and their results."""
    lines = [
        INTRODUCTION,
        '| case | image | at most | ' + ' | '.join(PARAMETERS) + ' | at most | remark |',
        '|---' * 9 + '|',
    ]
    for case, result in results:
        limits = [None] * 2 if result.image is None else [case.image, case.gradient]
        numbers = [result.image, limits[0], *(result.gradients.get(name) for name in PARAMETERS), limits[1]]
        remark = '; '.join(
            filter(
                None,
                (
                    result.refused and f'refused: {result.refused}',
                    result.warned and f'warned: {result.warned}',
                    case.note,
                ),
            )
        )
        cells = [case.name, *('' if x is None else f'{x:.0e}' for x in numbers), remark]
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


INTRODUCTION = """# Hard cases

Written by `python scripts/hard_cases.py --markdown docs/hard_cases.md`; asserted by `tests/test_hard_cases.py`. Errors in float32
against float64 on the same input, relative: of the image, its root mean square deviation over its own; of derivatives by the
Gaussians' parameters, the worst Gaussian's, each kind over the length of all of that Gaussian's derivatives, made numbers of one
unit (`tests/hard_cases.py` says how). *At most* is what the tests allow.
"""


# ------------------------------------------------------------------------------------------------------------
#  The cases
# ------------------------------------------------------------------------------------------------------------


def turned(rng, n):
    """n random orientations, and among the first the axes and diagonals of the world."""
    special = Rotation.from_euler(
        'zyx', [(0, 0, 0), (90, 0, 0), (0, 90, 0), (45, 0, 0), (0, 45, 0), (45, 45, 0)], degrees=True
    )
    return np.concatenate([special.as_quat(), Rotation.random(n, random_state=rng).as_quat()])


def through_view(rng, scale, frames, shape, rotation, reach=1.5, depth=0.3):
    """Gaussians that all reach into the view but whose centres may lie far outside.

    Each has a point that projects into the panel, up to `reach` standard deviations from its centre along each axis.
    """
    n = len(rotation)
    scale = np.broadcast_to(np.array(scale, float), (n, 3))
    height, width = shape
    x, y = rng.uniform(0, width, (n, 1)), rng.uniform(0, height, (n, 1))
    on_panel = frames.corner[0] + x * frames.u[0] + y * frames.v[0]
    share = rng.uniform(0.5 * (1 - depth), 0.5 * (1 + depth), (n, 1)) * 4 / 3
    if frames.parallel:
        point = on_panel - 2.5 * frames.source[0]
    else:
        point = frames.source[0] + share * (on_panel - frames.source[0])
    off = rng.uniform(-reach, reach, (n, 3)) * scale
    return Cloud(point + Rotation.from_quat(rotation).apply(off), scale, rotation, rng.uniform(0.2, 1, n))


def close_up(mode, shape=(24, 32), pixel=1.5e-4, **changes):
    """A panel of tiny pixels that sees the middle of the scene under a magnifying glass."""
    return scanner(mode, shape, size=(shape[0] * pixel, shape[1] * pixel), **changes)


def cases(steps: int = 300) -> list:
    """All cases. steps   of the fit to adversarial data"""
    return [
        *_shapes(),
        *_sizes(),
        *_densities(),
        *_places(),
        *_numbers(),
        *_geometries(),
        *_voxels(),
        *_unusable(),
        *_scans(steps),
    ]


def _shapes():
    rng = np.random.default_rng(1)
    for mode in ('cone', 'parallel'):
        views = {'close up': close_up(mode), 'whole': scanner(mode)}
        for kind, scale in dict(needles=(0.3, 3e-5, 3e-5), pancakes=(0.3, 0.3, 3e-5)).items():
            for where, view in views.items():
                yield Case(f'{kind} 1:1e4, {mode}, {where}', through_view(rng, scale, *view, turned(rng, 40)), *view)
        view = close_up(mode)
        yield Case(f'needles 1:1e4 seen end on, {mode}', _end_on(rng, (0.3, 3e-5, 3e-5), *view), *view)
        yield Case(f'pancakes 1:1e4 seen edge on, {mode}', _end_on(rng, (0.3, 3e-5, 0.3), *view), *view)


def _end_on(rng, scale, frames, shape, n=30):
    """Gaussians whose first axis points along the beam but for up to a few times their aspect."""
    beam = frames.corner[0] + shape[1] / 2 * frames.u[0] + shape[0] / 2 * frames.v[0] - frames.source[0]
    beam = frames.source[0] if frames.parallel else beam / np.linalg.norm(beam)
    side = np.cross(beam, [0, 0, 1])
    basis = Rotation.from_matrix(np.stack([beam, side / np.linalg.norm(side), np.cross(beam, side)], 1))
    tilt = Rotation.from_rotvec(rng.normal(size=(n, 3)) * [3, 3e-4, 3e-4])
    return through_view(rng, scale, frames, shape, (basis * tilt).as_quat(), reach=0.3, depth=0)


def _sizes():
    for mode in ('cone', 'parallel'):
        frames, shape = scanner(mode)
        pixel = np.linalg.norm(frames.u[0]) / (1 if mode == 'parallel' else 1.5)
        for power in (-6, -4, -2, -1, 0):
            rng = np.random.default_rng(10 + power)
            size = pixel * 10.0**power
            cloud = _on_pixel_centres(rng, frames, shape, size, 16)
            yield Case(f'scale 1e{power} pixels, {mode}', cloud, frames, shape, analytic=power == -6)
        for size in (2.0, 20.0):
            rng = np.random.default_rng(5)
            scale = size * rng.uniform(0.7, 1.3, (3, 3))
            cloud = Cloud(rng.uniform(-1, 1, (3, 3)), scale, rng.normal(size=(3, 4)), [0.2, 0.4, 0.6])
            yield Case(f'scale of {size / 2:g} scenes, {mode}', cloud, frames, shape)


def _on_pixel_centres(rng, frames, shape, size, n):
    """Gaussians of about one size within a standard deviation or two of the ray of a pixel's centre."""
    x, y = rng.integers(2, shape[1] - 2, (n, 1)) + 0.5, rng.integers(2, shape[0] - 2, (n, 1)) + 0.5
    on_panel = frames.corner[0] + x * frames.u[0] + y * frames.v[0]
    if frames.parallel:
        beam = frames.source[0]
        points = on_panel - 2.5 * beam
    else:
        beam = on_panel - frames.source[0]
        points = frames.source[0] + beam / 1.5
    points = np.float32(points + size * rng.normal(size=(n, 3))).astype(float)
    if size < 1e-3:
        # The nearest float32 numbers may miss the ray by many standard deviations: of the places along it, take those
        # that miss it by about one.
        start = on_panel if frames.parallel else frames.source[0]
        along = np.broadcast_to(beam, on_panel.shape) / np.linalg.norm(beam, axis=-1, keepdims=True)
        t = np.linspace(-0.3, 0.3, 4001)[:, None, None]
        trial = np.float32(points + t * along).astype(float)  # [4001, n, 3]
        r = trial - start
        miss = np.linalg.norm(r - (r * along).sum(-1, keepdims=True) * along, axis=-1)
        points = trial[np.abs(miss - size).argmin(0), np.arange(n)]
    return Cloud(points, size * rng.uniform(0.7, 1.4, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.2, 1, n))


def _densities():
    for mode in ('cone', 'parallel'):
        frames, shape = scanner(mode)
        for value in (0.0, 1e-12, 1e6):
            cloud = random_cloud(np.random.default_rng(3), 12)
            yield Case(f'density {value:g}, {mode}', cloud.changed(density=np.full(12, value)), frames, shape)
        cloud = random_cloud(np.random.default_rng(4), 12)
        for length in (1e-12, 1e12):
            q = cloud.rotation / np.linalg.norm(cloud.rotation, axis=1, keepdims=True)
            yield Case(f'quaternions of length {length:g}, {mode}', cloud.changed(rotation=length * q), frames, shape)


def _places():
    ahead = -np.array([np.cos(np.radians(33)), np.sin(np.radians(33)), 0])  # from the source to the panel's middle
    side = np.array([-ahead[1], ahead[0], 0])
    one = dict(scale=[[0.2, 0.16, 0.26]], rotation=[[0.1, 0.4, -0.3, 0.8]], density=[0.7])
    frames, shape = scanner()
    source = np.float32(frames.source[0])
    places = {
        'centre outside the fan, reaching in': (1.9 * side, 1),
        'centre outside the fan': (4 * side, 1),
        'centre 1000 scenes above the fan': ([0, 0, 2e3], 1),
        'behind the source': (6.5 * -ahead, 1),
        'behind the source, reaching ahead': (5.4 * -ahead, 1),
        'beside the source': (source + 0.9 * side, 1),
        'just ahead of the source': (4.6 * -ahead, 0.6),
        'centre at the source': (source, 1),
        'source inside a Gaussian': (5 * -ahead + 0.05, 1),
        'source inside a tiny Gaussian': (source + 3e-5, 3e-4),
        'centre on the panel': (2.5 * ahead + 0.3 * side, 1),
        'centre on the panel, below a pixel': (2.5 * ahead, 0.1),
        'behind the panel': (3.9 * ahead, 1),
        'behind the panel, reaching through': (2.9 * ahead, 0.8),
        'from source to panel': (0 * ahead, 6),
    }
    for panel in (True, False):
        for name, (centre, size) in places.items():
            cloud = Cloud([centre], size * np.array(one['scale']), one['rotation'], one['density'])
            tail = dict(image=2e-6, note='a far tail only') if name.startswith('centre outside the fan, r') else {}
            yield Case(name if panel else f'{name}, no panel', cloud, frames, shape, panel=panel, **tail)
    frames, shape = scanner('parallel')
    for name in ('centre outside the fan, reaching in', 'behind the source', 'centre on the panel', 'behind the panel'):
        centre, size = places[name]
        cloud = Cloud([centre], size * np.array(one['scale']), one['rotation'], one['density'])
        yield Case(f'{name}, parallel: never cut'.replace('the fan', 'the beam'), cloud, frames, shape)
    frames, shape = scanner(shape=(25, 33))
    turn = Rotation.from_euler('z', 33 + 1e-4, degrees=True).as_quat()[None]
    for kind, scale in dict(needle=(0.3, 3e-5, 3e-5), pancake=(0.3, 0.3, 3e-5)).items():
        yield Case(f'{kind} 1:1e4 through the source', Cloud([source + 2e-6], [scale], turn, [1.0]), frames, shape)


def _numbers():
    note = 'added one by one in float32, a thousand at a time'
    for mode in ('cone', 'parallel'):
        frames, shape = scanner(mode)
        cloud = random_cloud(np.random.default_rng(6), 1)
        yield Case(f'one Gaussian, {mode}', cloud, frames, shape)
        yield Case(f'30 coincident Gaussians, {mode}', cloud, frames, shape, copies=30)
        yield Case(f'3000 coincident Gaussians, {mode}', cloud, frames, shape, image=3e-6, copies=3000, note=note)
        sharp, _ = scanner(mode, size=(0.4, 0.5))
        small = Cloud([[0, 0, 0]], [[0.004, 0.005, 0.006]], [[0.1, 0.4, -0.3, 0.8]], [1.0])
        yield Case(f'pixels 30 standard deviations out, {mode}', small, sharp, shape)
    frames, shape = scanner(shape=(4, 4), size=(0.4, 0.4))
    cloud = random_cloud(np.random.default_rng(6), 1, spread=0.1, size=0.1)
    yield Case('1 million coincident Gaussians', cloud, frames, shape, image=3e-6, copies=1_000_000, note=note)
    cloud = random_cloud(np.random.default_rng(6), 1_000_000, size=0.005)
    yield Case('1 million Gaussians', cloud, *scanner(shape=(3, 3)), image=2e-6, note=note)


def _geometries():
    cloud = random_cloud(np.random.default_rng(7), 12)
    for mode in ('cone', 'parallel'):
        for shape, size in (((1, 1), (0.05, 0.05)), ((1, 4096), (0.01, 3.0)), ((4096, 1), (3.0, 0.01))):
            frames, _ = scanner(mode, shape, size=size)
            near = cloud.changed(centre=cloud.centre * ([0.05, 0.05, 0.05] if shape == (1, 1) else [1, 1, 0.03]))
            yield Case(f'{shape[0]} x {shape[1]} pixels, {mode}', near, frames, shape)
        for shift in (1e4, 1e6):
            frames, shape = scanner(mode)
            shift = np.array([2.0, -1.4, 0.9]) * shift
            # Float32 names places this far out only to a thousandth of the scene: what counts is where they are.
            size = cloud.changed(centre=cloud.centre + shift)
            moved = Rays(
                frames.source + (0 if frames.parallel else shift),
                frames.corner + shift,
                frames.u,
                frames.v,
                frames.parallel,
            )
            yield Case(f'world offset of {np.abs(shift).max() / 2:.0e} scenes, {mode}', size, moved, shape)
        for angle in (33.0, 33.0 + np.degrees(1e-6)):
            frames, shape = scanner(mode, angle=angle)
            yield Case(f'view at {np.radians(angle):.7f} rad, {mode}', cloud, frames, shape)
    far = scanner(DSO=5e4, DSD=7.5e4)
    yield Case('cone beam from 25000 scenes away', cloud, *far)
    wide = scanner(DSO=1.9, DSD=2.9, size=(12, 14))
    yield Case('cone of 157 degrees', cloud, *wide)
    yield Case('pixels 1000 times as wide as high', cloud, *scanner(shape=(1000, 3), size=(1.0, 3.0)))


def _voxels():
    rng = np.random.default_rng(8)
    for kind, scale in dict(needles=(0.3, 3e-5, 3e-5), pancakes=(0.3, 0.3, 3e-5)).items():
        rotation, step, shape = turned(rng, 20), np.full(3, 4e-5), (12, 11, 10)
        corner, n = np.array([0.2, -0.1, 0.05]), len(rotation)
        off = Rotation.from_quat(rotation).apply(rng.uniform(-1.5, 1.5, (n, 3)) * scale)
        centre = corner + rng.uniform(0, 1, (n, 3)) * step * shape + off
        cloud = Cloud(centre, np.tile(scale, (n, 1)), rotation, rng.uniform(0.2, 1, n))
        yield VoxelCase(f'voxels: {kind} 1:1e4', cloud, corner, step, shape)
    step, corner, shape, n = np.full(3, 0.1), np.full(3, -0.6), (12, 12, 12), 16
    for power in (-6, -4, -2, -1):
        size = 0.1 * 10.0**power
        centre = corner + (rng.integers(1, 11, (n, 3)) + 0.5) * step
        # Where float32 can name places so close to a voxel's centre: around the origin.
        corner_of = corner - 0.05 if power < -2 else corner
        centre = centre * (power >= -2) + size * rng.normal(size=(n, 3))
        cloud = Cloud(centre, size * rng.uniform(0.7, 1.4, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.2, 1, n))
        yield VoxelCase(f'voxels: scale 1e{power} voxels', cloud, corner_of, step, shape)
    yield VoxelCase('voxels: scale of 10 scenes', random_cloud(rng, 4, size=20.0), corner, step, shape)
    yield VoxelCase('voxels: density 1e6', random_cloud(rng, 6).changed(density=np.full(6, 1e6)), corner, step, shape)
    far = random_cloud(rng, 10)
    far = far.changed(centre=far.centre + 2e4)
    yield VoxelCase('voxels: world offset of 1e4 scenes', far, corner + 2e4, step, shape)


def _unusable():
    usable = dict(centre=[[0, 0, 0]], scale=[[0.1, 0.1, 0.1]], rotation=[[0, 0, 0, 1]], density=[1.0])
    for name, changes in {
        'zero quaternion': dict(rotation=[[0, 0, 0, 0]]),
        'NaN in a quaternion': dict(rotation=[[np.nan, 0, 0, 1]]),
        'NaN in a centre': dict(centre=[[0, np.nan, 0]]),
        'zero scale': dict(scale=[[0.1, 0, 0.1]]),
        'negative scale': dict(scale=[[0.1, -0.1, 0.1]]),
        'infinite scale': dict(scale=[[np.inf, 0.1, 0.1]]),
        'NaN density': dict(density=[np.nan]),
        'density 1e30': dict(density=[1e30]),
        'scale 1e-20': dict(scale=[[1e-20] * 3]),
        'centre at 1e20': dict(centre=[[1e20, 0, 0]]),
        'needle 1:1e8': dict(scale=[[1, 1e-8, 1e-8]]),
    }.items():
        yield ScanCase(name, partial(_render, Cloud(**{**usable, **changes})), refused='Gaussian 0 of the ellipsoids')
    needle = Cloud(**{**usable, 'scale': [[1, 2e-7, 2e-7]]})
    yield ScanCase('needle 1:5e6', partial(_render, needle), warned=True)


def _render(cloud):
    data = np.concatenate([cloud.centre, cloud.scale, cloud.rotation], 1)
    scene = mi.load_dict(
        dict(
            type='scene',
            integrator=dict(type='lingo_xray'),
            cloud=dict(
                type='ellipsoids',
                data=mi.TensorXf(np.float32(data)),
                density=mi.TensorXf(np.float32(cloud.density)[:, None]),
            ),
            scanner=dict(
                type='ct_scanner', DSO=5.0, DSD=7.5, nDetector='8', dDetector='.4', nVoxel='8', dVoxel='.25', views=1
            ),
        )
    )
    scene.integrator().render(scene, scene.sensors()[0])


# ------------------------------------------------------------------------------------------------------------
#  Scans
# ------------------------------------------------------------------------------------------------------------


def measured(angles, shape=(24, 24)):
    """A scan of some Gaussians, exact."""
    geometry = Geometry(
        DSO=5.0, DSD=7.5, nDetector=shape, dDetector=3.4 / max(shape), nVoxel=16, dVoxel=0.125, angles=angles
    )
    cloud, frames = random_cloud(np.random.default_rng(9), 6, spread=0.4, size=0.15), geometry.rays()
    images = [oracle.line_integrals(cloud, Pose.of(frames, i, *shape)) for i in range(len(geometry))]
    return Scan(geometry, np.reshape(images, (-1, *shape)))


def points(n=50):
    """An initial cloud, some of it in pairs and a tenth all at one place."""
    rng = np.random.default_rng(10)
    centre = rng.uniform(-0.6, 0.6, (n, 3))
    centre[n // 2 : n // 2 + n // 5] = centre[: n // 5]
    centre[-(n // 10) :] = 0
    return InitialCloud(centre, np.full(n, 0.2), np.full(n, 0.1))


def fit_to(scan, iterations, **changes):
    """A fit that densifies often; raises AssertionError unless it ends finite and within its bounds."""
    settings = FAST.changed(
        **{
            **dict(
                iterations=iterations,
                densify_from=20,
                densify_until=iterations,
                densify_every=25,
                densify_threshold=1e-3,
                max_gaussians=200,
                tv_size=8,
                loss_scale='dynamic',
            ),
            **changes,
        }
    )
    done = fit(scan, settings, points(), seed=1)
    centre, scale, rotation, density = activate(done.state, done.settings)
    assert all(np.isfinite(x).all() for x in (centre, scale, rotation, density)) and len(density)
    assert all(np.isfinite(x).all() for c in (done.state.first, done.state.second) for x in c.values())
    # The sigmoid reaches its bounds where float32 saturates.
    assert scale.min() >= done.settings.scale_min and scale.max() <= done.settings.scale_max
    assert all(np.isfinite(entry['loss']) for entry in done.history)
    return done


def adversarial():
    """Eight views: two of them empty, one saturated, one with negative noise, one there twice."""
    angles = circular(8)
    angles[4] = angles[2]
    scan = measured(angles)
    p = scan.projections.copy()
    p[[1, 6]] = 0
    p[3] = p.max() * 30
    p[5] += np.random.default_rng(11).normal(size=p[5].shape) * p.max()
    return Scan(scan.geometry, p)


def _scans(steps):
    def changed(change):
        scan = measured(circular(3))
        return Scan(scan.geometry, np.broadcast_to(change(scan.projections), scan.projections.shape))

    def holed(p):
        return np.where(np.arange(p.shape[2]) == 4, np.nan, p)

    yield ScanCase('projections with NaN', lambda: changed(holed), refused='NaN or infinity')
    yield ScanCase('projections all zero', lambda: fit_to(changed(np.zeros_like), 5), refused='zero everywhere')
    finite = 'fit ends finite'
    yield ScanCase('projections constant', lambda: fit_to(changed(lambda p: 0.3), 40), note=finite)
    yield ScanCase('projections with negative values', lambda: fit_to(changed(lambda p: p - 0.1), 40), note=finite)
    yield ScanCase('1 view', lambda: fit_to(measured(circular(1)), 20), note=finite)
    yield ScanCase('2 views', lambda: fit_to(measured(circular(2)), 20), note=finite)
    yield ScanCase('1000 views', lambda: fit_to(measured(circular(1000), (8, 8)), 20), note=finite)
    yield ScanCase('views 1e-6 rad apart', lambda: fit_to(measured(np.arange(3) * 1e-6), 40), note=finite)
    yield ScanCase(
        f'{steps} steps: views empty, saturated, noisy, repeated; Gaussians coincident',
        lambda: fit_to(adversarial(), steps),
        note=finite,
    )
