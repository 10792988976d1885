"""Other ways to compute the projections of a cloud of Gaussians, to compare the splat with.

- `per_ray`: the closed form of every Gaussian on every ray, in float32, float64 or with a compensated sum
- `march`: a grid marched with fixed steps
- `Tree`: Mitsuba's own acceleration structure over `ellipsoids`: closest hit, add the closed form, step on by epsilon
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.footprint import SQRT_2PI
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.rotation import rotate_inverse, rows_of
from lingo_mi.projectors.view import View


@full_float64()
def rays(view: View, distance: float) -> tuple[Any, Any]:
    """Origins Point3f and unit directions Vector3f of a cone beam's rays, row by row.

    They start `distance` before they are nearest to the world's origin, or at the source: near the object float32 has
    more digits left.
    """
    Float64 = dr.value_t(mi.Vector3d)
    i, width = dr.arange(mi.UInt32, view.height * view.width), dr.opaque(mi.UInt32, view.width)
    point = view.corner + (Float64(i % width) + 0.5) * view.u + (Float64(i // width) + 0.5) * view.v
    direction = dr.normalize(point - view.source)
    origin = view.source + dr.maximum(-dr.dot(view.source, direction) - distance, 0) * direction
    origin, direction = mi.Point3f(origin), mi.Vector3f(direction)
    dr.eval(origin, direction)
    return origin, direction


# ------------------------------------------------------------------------------------------------------------
#  Every Gaussian on every ray
# ------------------------------------------------------------------------------------------------------------


def per_ray(centre: Any, scale: Any, rotation: Any, density: Any, view: View, precision: str = 'float32') -> Any:
    """Line integrals along whole rays, without a cut-off; arguments as for `cloud.line_integrals`.

    Float [height * width] of that precision.

    Parameters
    ----------
    precision : str
        'float32' or 'float64', of everything; or 'compensated': float32, summed as Kahan does, which has no derivatives here.
    """
    with full_float64() if precision == 'float64' else nullcontext():
        return _per_ray(centre, scale, rotation, density, view, precision)


def _per_ray(centre, scale, rotation, density, view, precision):
    Float: Any = dr.float64_array_t(mi.Float) if precision == 'float64' else mi.Float
    Vector: Any = mi.Vector3d if precision == 'float64' else mi.Vector3f
    i = dr.arange(mi.UInt32, view.height * view.width)
    width = dr.opaque(mi.UInt32, view.width)
    x, y = Float(i % width) + 0.5, Float(i // width) + 0.5
    point = Vector(view.corner) + x * Vector(view.u) + y * Vector(view.v)
    source = Vector(view.source)
    start, direction = (point, source) if view.parallel else (source, point - source)
    p, s, rho = Vector(centre), Vector(scale), Float(density)
    Vector4: Any = dr.float64_array_t(type(rotation)) if precision == 'float64' else type(rotation)
    q = Vector4(rotation)
    # Columns of diag(1/s) R^T: turning every ray by every quaternion would cost more than all the rest.
    axes = [row / s for row in rows_of(q, Vector)]
    columns = [*p, *(a for axis in axes for a in axis), rho * SQRT_2PI]
    dr.eval(columns)
    count = dr.opaque(mi.UInt32, dr.width(rho))
    total = _sum_gaussians(columns, start, direction, count, Float, Vector, precision == 'compensated')
    return total * dr.norm(direction)


@dr.syntax
def _sum_gaussians(columns, start, direction, count, Float, Vector, compensated):
    total, lost, g = Float(0), Float(0), mi.UInt32(0)
    while dr.hint(g < count, max_iterations=-1):
        c = [dr.gather(Float, column, g) for column in columns]
        to = Vector(c[0], c[1], c[2]) - start
        rows = Vector(c[3], c[4], c[5]), Vector(c[6], c[7], c[8]), Vector(c[9], c[10], c[11])
        w = rows[0] * to.x + rows[1] * to.y + rows[2] * to.z
        d = rows[0] * direction.x + rows[1] * direction.y + rows[2] * direction.z
        inverse = 1 / dr.squared_norm(d)
        nearest = w - dr.dot(w, d) * inverse * d
        value = c[12] * dr.sqrt(inverse) * dr.exp(-0.5 * dr.squared_norm(nearest))
        if dr.hint(compensated, mode='scalar'):
            value -= lost
            larger = total + value
            lost = (larger - total) - value
            total = larger
        else:
            total += value
        g += 1
    return total


# ------------------------------------------------------------------------------------------------------------
#  A marched grid
# ------------------------------------------------------------------------------------------------------------


def march(data: Any, size: int, half: float, origin: Any, direction: Any, step: float) -> Any:
    """Line integrals of a grid by the midpoint rule with steps of `step` along the rays, in the box [-half, half]^3.

    Differentiable in `data`.

    Parameters
    ----------
    data : Float [size^3]
        x fastest: values at the voxel centres, interpolated trilinearly.
    origin, direction : Point3f, Vector3f
    """
    Texture: Any = mi.Texture3f
    texture = Texture(
        mi.TensorXf(data, shape=(size, size, size, 1)),
        use_accel=False,
        migrate=False,
        filter_mode=dr.FilterMode.Linear,
        wrap_mode=dr.WrapMode.Clamp,
    )
    length = dr.norm(direction)
    d = direction / length
    d = dr.select(dr.abs(d) < 1e-9, 1e-9, d)
    a, b = (-half - origin) / d, (half - origin) / d
    first, last = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
    return _march(texture, mi.Vector3f(origin), d, first, last, dr.opaque(mi.Float, step), dr.opaque(mi.Float, half))


@dr.syntax
def _march(texture, origin, d, first, last, step, half):
    t, total = first + 0.5 * step, mi.Float(0)
    while dr.hint(t < last, max_iterations=-1):
        total += texture.eval((origin + t * d) / (2 * half) + 0.5)[0] * step
        t += step
    return total


# ------------------------------------------------------------------------------------------------------------
#  Mitsuba's tree
# ------------------------------------------------------------------------------------------------------------


class Tree:
    """Marching through the tree of an `ellipsoids` shape, hit by hit, by `o = si.p + epsilon d`.

    A hit is the point at which a ray enters an ellipsoid, so two ellipsoids that are entered within epsilon count once, and
    rounding of the hit's position may count one twice. A second walk takes the derivatives of the closed form at the hits that
    were found.
    """

    def __init__(self, data: Any, density: Any, extent: float, epsilon: float):
        """data      TensorXf [N, 10], as `ellipsoids` takes it, with unit quaternions
        density   TensorXf [N, 1]
        extent    cut-off in standard deviations
        epsilon   a length
        """
        cloud = dict(type='ellipsoids', data=data, density=density, extent=extent)
        self.scene = mi.load_dict(dict(type='scene', cloud=cloud))
        self.data, self.density = mi.Float(data.array), mi.Float(density.array)
        self.epsilon = epsilon

    def image(self, origin: Any, direction: Any) -> Any:
        """Line integrals along rays, Float [rays]. origin, direction   Point3f, Vector3f of length 1"""
        image = _walk(
            self.scene,
            mi.Point3f(origin),
            mi.Vector3f(direction),
            (self.data, self.density),
            dr.opaque(mi.Float, self.epsilon),
            mi.Float(0),
            False,
        )
        dr.eval(image)
        return image

    def gradients(self, origin: Any, direction: Any, upstream: Any) -> tuple[Any, Any]:
        """Derivatives of sum(upstream * image) by data, Float [10 N], and by density, Float [N]."""
        for array in (self.data, self.density):
            dr.enable_grad(array)
            dr.set_grad(array, 0)
        with dr.suspend_grad():
            done = _walk(
                self.scene,
                mi.Point3f(origin),
                mi.Vector3f(direction),
                (self.data, self.density),
                dr.opaque(mi.Float, self.epsilon),
                upstream,
                True,
            )
            dr.eval(done)
        out = dr.grad(self.data), dr.grad(self.density)
        dr.eval(out)
        dr.disable_grad(self.data, self.density)
        return out


@dr.syntax
def _walk(scene, o, d, gaussians, epsilon, upstream, backward):
    total, active = mi.Float(0), mi.Bool(True)
    while active:
        si = scene.ray_intersect_preliminary(mi.Ray3f(o, d), coherent=False, active=active)
        active &= si.is_valid()
        if dr.hint(backward, mode='scalar'):
            with dr.resume_grad():
                value = _closed_form(o, d, gaussians, si.prim_index, active)
                dr.backward_from(value * upstream)
        else:
            total += _closed_form(o, d, gaussians, si.prim_index, active)
        o = mi.Point3f((o + d * si.t) + epsilon * d)
    return total


def _closed_form(o, d, gaussians, index, active):
    """The line integral through Gaussian `index` of (data, density); 0 if not active. d is of length 1."""
    data, density = gaussians
    c = [dr.gather(mi.Float, data, index * 10 + j, active) for j in range(10)]
    rows = rows_of(dr.select(active, mi.Vector4f(*c[6:]), mi.Vector4f(0, 0, 0, 1)), mi.Vector3f)
    s = dr.select(active, mi.Vector3f(*c[3:6]), 1)
    w, v = rotate_inverse(rows, mi.Vector3f(*c[:3]) - mi.Vector3f(o)) / s, rotate_inverse(rows, d) / s
    inverse = 1 / dr.squared_norm(v)
    nearest = w - dr.dot(w, v) * inverse * v
    rho = dr.gather(mi.Float, density, index, active)
    return dr.select(active, rho * SQRT_2PI * dr.sqrt(inverse) * dr.exp(-0.5 * dr.squared_norm(nearest)), 0)
