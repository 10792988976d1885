"""The attenuating objects of a Mitsuba scene: clouds of Gaussians, grids in cubes, closed meshes."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.projectors import cloud, grid
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.usable import require_usable
from lingo_mi.projectors.view import View

# Caches of prepared meshes and of clouds known to be usable; Mitsuba's shapes cannot hold them. An array's index is part of
# the key, so the array is kept alive: otherwise Dr.Jit could reuse the index.
_MESHES: dict = {}
MOST_MESHES = 64
_USABLE: dict = {}
MOST_USABLE = 2


def find_objects(scene: mi.Scene) -> list:
    """The attenuating objects of a scene.

    Raises
    ------
    InputError
        For an object that `lingo_xray` cannot integrate, and for a scene without objects.
    """
    objects = [obj for shape in scene.shapes() for obj in _objects(shape, scene)]
    if not objects:
        raise InputError(
            'the scene has nothing that attenuates: add ellipsoids with a density, a cube with a '
            'heterogeneous medium or a closed mesh with a homogeneous one'
        )
    return objects


def _objects(shape: mi.Shape, scene: mi.Scene) -> list:
    """Return the objects of a shape that attenuate. An instance has the objects of its group, moved."""
    if shape.class_name() != 'Instance':
        obj = _object(shape)
        return [] if obj is None else [obj]
    # An instance does not tell its group: the name is read from its description, the group found among the scene's.
    name = re.findall(r'ShapeGroup\[\s*name = "(.*)"', str(shape))
    nodes = mi.traverse(scene).hierarchy
    groups = [node for node in nodes if isinstance(node, mi.Shape) and str(node).startswith('ShapeGroup[')]
    groups = [group for group in groups if [group.id()] == name]
    if len(groups) != 1:
        raise InputError(f'lingo_xray does not find the shapegroup of the instance {shape.id()!r}: give each an id')
    inside = [node for node, (parent, _) in nodes.items() if parent is groups[0] and isinstance(node, mi.Shape)]
    return [Instance(shape, obj) for part in inside if (obj := _object(part)) is not None]


def _object(shape: mi.Shape) -> Ellipsoids | GridInCube | HomogeneousMesh | None:
    if shape.is_ellipsoids():
        return Ellipsoids(shape)
    medium = shape.interior_medium()
    if medium is None:
        return None
    kind = str(medium).split('[')[0]
    if kind == 'HeterogeneousMedium':
        return GridInCube(shape, medium)
    if kind == 'HomogeneousMedium':
        return HomogeneousMesh(shape, medium)
    raise InputError(
        f'lingo_xray does not know the medium {kind} of the shape {shape.id()!r}: use a heterogeneous or a '
        'homogeneous one'
    )


class Ellipsoids:
    """The built-in `ellipsoids` shape with an attribute `density` [N, 1], as a cloud of Gaussians."""

    def __init__(self, shape: mi.Shape):
        params: Any = mi.traverse(shape)
        self.name = shape.id()
        if 'density' not in params:
            raise InputError(f'the ellipsoids {shape.id()!r} have no attribute "density": give it one value a Gaussian')
        data, self.density = params['data'], params['density']
        self.second = params.get('second')  # share of a second material
        count, rest = divmod(dr.width(data), 10)
        for name, column in (('density', self.density), ('second', self.second)):
            if column is not None and (rest or count == 0 or dr.width(column) != count):
                raise InputError(
                    f'the ellipsoids {shape.id()!r} have {dr.width(data)} numbers as data, 10 for each of at least one '
                    f'Gaussian, but {dr.width(column)} as {name}: give it one value a Gaussian'
                )
        self.rows, (self.centre, self.scale, self.rotation) = data, cloud.columns(data)
        shared = self.second is not None
        key = data.index, self.density.index, self.second.index if shared else 0
        if key in _USABLE:
            return
        if shared and not dr.all((self.second >= 0) & (self.second <= 1)):
            raise InputError(f'the ellipsoids {self.name!r}: "second" is a share in the density, from 0 to 1')
        gaussians = self.centre, self.scale, self.rotation, self.density
        if require_usable(*gaussians, where=f'the ellipsoids {self.name!r}'):
            while len(_USABLE) >= MOST_USABLE:
                _USABLE.pop(next(iter(_USABLE)))
            _USABLE[key] = tuple(dr.detach(x) for x in (data, self.density, self.second if shared else self.density))

    @classmethod
    def of(cls, centre: Any, scale: Any, rotation: Any, density: Any, second: Any, name: str) -> Ellipsoids:
        """Gaussians without a Mitsuba shape, not checked: Point3f, Vector3f, Vector4f and Float [N]. second may be None."""
        self = cls.__new__(cls)
        self.centre, self.scale, self.rotation, self.density = centre, scale, rotation, density
        self.second, self.name, self.rows = second, name, None
        return self

    def line_integrals(self, view: View, options: RenderOptions, primal: bool = True) -> Any:
        if self.rows is not None:
            return cloud.line_integrals_of_rows(self.rows, self.density, view, options, primal)
        return cloud.line_integrals(self.centre, self.scale, self.rotation, self.density, view, options, primal)


def _holds(volume, tensor) -> bool:
    """Return whether a volume of Mitsuba has these values. An albedo may be a grid, too."""
    data: Any = dict(mi.traverse(volume)).get('data')
    return data is not None and data.array.index == tensor.array.index


class GridInCube:
    """An axis-aligned `cube` with a heterogeneous medium whose extinction is a scalar `gridvolume`."""

    def __init__(self, shape: mi.Shape, medium: mi.Medium):
        self.name, where = shape.id(), f'the medium of the shape {shape.id()!r}'
        params: Any = mi.traverse(medium)
        tensor = next((v for k, v in params.items() if k.endswith('sigma_t.data')), None)
        if tensor is None or len(tensor.shape) not in (3, 4) or (len(tensor.shape) == 4 and tensor.shape[3] != 1):
            raise InputError(f'{where} must have a gridvolume with one channel as sigma_t')
        volume = next(node for node in params.hierarchy if isinstance(node, mi.Volume) and _holds(node, tensor))
        box: Any = volume.bbox()
        cube: Any = shape.bbox()
        if not (
            str(shape).startswith('Cube')
            and _axis_aligned(shape, volume)
            and np.allclose(box.min, cube.min, atol=1e-4 * np.abs(cube.max - cube.min))
            and np.allclose(box.max, cube.max, atol=1e-4 * np.abs(cube.max - cube.min))
        ):
            raise InputError(
                f'{where} must fill an axis-aligned cube exactly: give the cube, [-1, 1]^3 in its own frame, '
                'and the gridvolume, [0, 1]^3 in its own, transforms onto the same box'
            )
        self.scale = params.get('scale', 1.0)
        self.data, self.size = tensor.array, tensor.shape[2::-1]
        self.low, self.high = box.min, box.max

    @classmethod
    def of(cls, values: np.ndarray, low: Any, high: Any, name: str) -> GridInCube:
        """Densities [x, y, z] that fill the box from `low` to `high`, without a Mitsuba shape."""
        self = cls.__new__(cls)
        self.name, self.scale, self.size = name, 1.0, values.shape
        self.data = mi.Float(np.ascontiguousarray(values.transpose(2, 1, 0), np.float32).ravel())
        self.low, self.high = mi.ScalarPoint3f(low), mi.ScalarPoint3f(high)
        return self

    def line_integrals(self, view: View, options: RenderOptions, primal: bool = True) -> Any:
        _no_area(options)
        nx, ny, nz = self.size
        # The projector needs z fastest; Mitsuba stores x fastest.
        i = dr.arange(mi.UInt32, nx * ny * nz)
        z, rest = i % nz, i // nz
        data = dr.gather(mi.Float, self.data, (z * ny + rest % ny) * nx + rest // ny, mode=dr.ReduceMode.Permute)
        lines = _lines(view, (self.low + self.high) / 2)
        return grid.line_integrals(data, self.size, self.low, self.high, lines) * self.scale


def _no_area(options):
    if options.area:
        raise InputError(
            "lingo_xray: pixel = 'area' is for scenes of ellipsoids alone; with grids or meshes give n, for n x n rays"
        )


def _axis_aligned(cube, volume) -> bool:
    """Return whether cube and gridvolume are axis-aligned and the volume is not mirrored. Bounding boxes do not show this."""
    corners = np.array(mi.traverse(cube)['vertex_positions']).reshape(-1, 3)
    low, high = corners.min(0), corners.max(0)
    off_corner = np.minimum(corners - low, high - corners)
    # A volume's transform is not among its parameters; the matrix is read from its description.
    numbers = re.findall(r'matrix=\[(.*?)\]\]', str(volume), re.DOTALL)[0].replace('[', ' ').replace(']', ' ')
    matrix = np.array([float(x) for x in numbers.replace(',', ' ').split()]).reshape(4, 4)[:3, :3]
    scale = np.diag(matrix)
    return bool(
        np.all(off_corner <= 1e-4 * (high - low))
        and np.all(scale > 0)
        and np.all(np.abs(matrix - np.diag(scale)) <= 1e-4 * scale[:, None])
    )


class Instance:
    """An object of a `shapegroup`, moved by an affine transform, the `to_world` of an `instance`.

    The rays are moved back instead: a ray o + t D of the world is M^-1 o + t M^-1 D in the object's frame, so the line
    integral is the integral of the object, times |D| / |M^-1 D|. Derivatives reach the object and the transform.
    """

    def __init__(self, shape: mi.Shape, content: Any):
        self.name, self.content = content.name, content
        params: Any = mi.traverse(shape)
        self.to_world = params['to_world'].matrix

    def line_integrals(self, view: View, options: RenderOptions, primal: bool = True) -> Any:
        local, stretch = self._moved(view)
        return self.content.line_integrals(local, options, primal) * stretch

    @full_float64()
    def _moved(self, view):
        """The view in the object's frame, and |D| / |M^-1 D| of every pixel."""
        Vector3d = mi.Vector3d
        Float64 = dr.value_t(Vector3d)
        m = self.to_world
        columns = [Vector3d(*(Float64(m[i, j]) for i in range(3))) for j in range(4)]
        dr.make_opaque(columns)  # every pose would be a kernel of its own otherwise
        a, b, c, origin = columns
        rows = [r / dr.dot(a, dr.cross(b, c)) for r in (dr.cross(b, c), dr.cross(c, a), dr.cross(a, b))]

        def back(d):
            return Vector3d(*(dr.dot(row, d) for row in rows))

        source = back(view.source) if view.parallel else back(view.source - origin)
        local = replace(view, corner=back(view.corner - origin), u=back(view.u), v=back(view.v), source=source)
        if view.parallel:
            length = dr.norm(source)
            return replace(local, source=source / length), mi.Float(1 / length)
        return local, view.lengths() / local.lengths()


class HomogeneousMesh:
    """A closed mesh with a homogeneous medium inside."""

    def __init__(self, shape: mi.Shape, medium: mi.Medium):
        from lingo_mi.projectors.mesh import from_mitsuba

        self.name = shape.id()
        geometry: Any = mi.traverse(shape)
        if not shape.is_mesh() or 'vertex_positions' not in geometry:  # a rectangle says that it is a mesh
            raise InputError(
                f'the shape {shape.id()!r} has a homogeneous medium, but is not a mesh: use ply, obj or cube'
            )
        with dr.resume_grad():
            if dr.grad_enabled(geometry['vertex_positions']):
                raise InputError(
                    f'derivatives do not reach the vertices of the mesh {shape.id()!r}: switch them off with '
                    'dr.disable_grad, or fit ellipsoids or a grid instead'
                )
        params: Any = mi.traverse(medium)
        self.sigma = next(
            v for k, v in params.items() if k.endswith('sigma_t.value.value') or k.endswith('sigma_t.value')
        )
        self.scale = params.get('scale', 1.0)
        # A kept array's index is unique, so a moved mesh does not match the old entry.
        arrays = geometry['vertex_positions'], geometry['faces']
        key = (id(shape), *(x.index for x in arrays))
        if key not in _MESHES:
            while len(_MESHES) >= MOST_MESHES:
                _MESHES.pop(next(iter(_MESHES)))
            _MESHES[key] = (shape, arrays, from_mitsuba(shape))
        self.paths, self._arrays = _MESHES[key][-1], arrays

    def triangles(self) -> np.ndarray:
        """Corners, float64 [n, 3, 3]."""
        vertices, faces = (np.array(a).reshape(-1, 3) for a in self._arrays)
        return vertices[faces].astype(float)

    def line_integrals(self, view: View, options: RenderOptions, primal: bool = True) -> Any:
        _no_area(options)
        return self.paths.lengths(view) * mi.Float(self.sigma) * self.scale


def _lines(view: View, near: Any) -> grid.Lines:
    """The rays of all pixels, starting on the plane through `near` parallel to the panel.

    Starting near the object avoids the loss of float32 digits that a distant source would cause.
    """
    i = dr.arange(mi.UInt32, view.height * view.width)
    width = dr.opaque(mi.UInt32, view.width)
    x: Any = mi.Float(i % width) + 0.5
    y: Any = mi.Float(i // width) + 0.5
    if view.bend is not None:
        x, y = (mi.Float(p) for p in view.bend.on_plane(i % width, i // width))
    near = mi.Vector3d(*near)
    n = dr.cross(view.u, view.v)
    Float, Vector3f = mi.Float, mi.Vector3f
    if view.parallel:
        t = dr.dot(n, near - view.corner) / dr.dot(n, view.source)
        origin = Vector3f(view.corner + t * view.source) + x * Vector3f(view.u) + y * Vector3f(view.v)
        return grid.Lines(mi.Point3f(origin), Vector3f(view.source))
    axis = view.corner - view.source
    k = dr.dot(n, near - view.source) / dr.dot(n, axis)
    direction = Vector3f(axis) + x * Vector3f(view.u) + y * Vector3f(view.v)
    origin = Vector3f(view.source + k * axis) + x * Vector3f(k * view.u) + y * Vector3f(k * view.v)
    return grid.Lines(mi.Point3f(origin), direction, Float(-k))
