r"""The exact footprint of a Gaussian on a flat detector.

For a ray :math:`o + tD` and a Gaussian (p, R, s, rho), whitened by :math:`W = \mathrm{diag}(1/s) R^T` to
:math:`w = W(p - o)`, :math:`d = WD`, the line integral is

.. math::  \rho \sqrt{2\pi} \, |D| / |d| \; \exp(-\tfrac12 |w \times d|^2 / |d|^2).

On a flat detector :math:`D = k(p - o) + \delta x\, a + \delta y\, b`, with the pixel steps a and b and the pixel position
relative to the projected centre. The constant term of :math:`w \times d` vanishes, so nothing cancels near the centre:

    |w x d|^2 = |dx na + dy nb|^2             na = w x Wa,  nb = w x Wb
    |d|^2     = |k w + dx Wa + dy Wb|^2

Both are divided by (k|w|)^2, and the first is sheared to a sum of two squares, t = dx + shear dy:

    num = (mx t)^2 + (my dy)^2
    den = 1 + e1 t + e2 dy + e11 t^2 + 2 e12 t dy + e22 dy^2
    integral = |D| amplitude den^(-1/2) exp(-num / (2 den))

The sum of squares is what keeps a needle's footprint accurate in float32. For a parallel beam den = 1. These eleven numbers
a Gaussian (amplitude, mx, my, shear, e1 ... e22, and the centre) are computed in float64, which costs nothing beside the
pixels and saves the digits that differences of world coordinates lose. Shear and centre are handed on in float64, since a
needle that crosses the image cancels t to its own width, the others in float32.

The footprint at the cut-off of kappa standard deviations is the conic |w x d| <= kappa |d|: an ellipse as long as the
kappa-ellipsoid lies between source and detector. Gaussians for which it does not are left to `segment`.
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

SQRT_2PI = 2.5066282746310002

# Names of the differentiable numbers, in the order in which the kernels keep them.
NAMES = ('amplitude', 'mx', 'my', 'shear', 'e1', 'e2', 'e11', 'e12', 'e22', 'x', 'y')
DOUBLE = 'shear', 'x', 'y'


@dataclass
class Footprints:
    """Footprints of N Gaussians in one view.

    values    the eleven differentiable numbers named in NAMES, [N] each: Float, but Float64 for those in DOUBLE; x and y
              place the projected centre, in pixels from the centre of the pixel (column, row) in which it lies
    column, row            Int32 [N]
    row_begin, row_end     Int32 [N], rows of the footprint, clipped to the image; empty where it has none
    width                  Float [N], pixels across the widest row, for balancing work
    area                   Float [N], pixels covered: of the ellipse, or of the box where that is smaller
    straddles              Bool [N], Gaussians that this chart cannot express and `segment` must integrate; also those that
                           nothing can, because a number is not finite or a scale or quaternion zero
    """

    values: tuple
    column: object
    row: object
    row_begin: object
    row_end: object
    width: object
    area: object
    straddles: object

    @property
    def seen(self):
        """Whether a Gaussian has pixels in the image, Bool [N]."""
        return self.row_end > self.row_begin


def rotate_inverse(q, v):
    """R^T v for the unit quaternion q = (x, y, z, w), a 4-vector (`mi.Quaternion4f` would multiply as one)."""
    u = type(v)(-q.x, -q.y, -q.z)
    c = 2 * dr.cross(u, v)
    return v + q.w * c + dr.cross(u, c)


def project(centre, scale, rotation, density, view, extent: float, widen: float = 0.) -> Footprints:
    """Footprints of N Gaussians in a view.

    centre, scale   Point3f, Vector3f [N]; standard deviations
    rotation        Vector4f [N], quaternion (x, y, z, w), normalised here
    density         Float [N], value at the centre
    extent          cut-off in standard deviations
    widen           variance in pixels^2 of a round Gaussian that footprints are convolved with, |d|^2 taken as constant
    """
    Vector3d = mi.Vector3d
    Float64 = dr.value_t(Vector3d)
    p, s, rho = Vector3d(centre), Vector3d(scale), Float64(density)
    q = dr.float64_array_t(type(rotation))(rotation)
    q = q * dr.rsqrt(dr.squared_norm(q))
    a, b = view.u, view.v
    n = dr.cross(a, b)

    if view.parallel:
        to_plane = p - view.corner
        hit = to_plane - view.source * (dr.dot(n, to_plane) / dr.dot(n, view.source))
        w = rotate_inverse(q, view.source) / s
        visible = dr.isfinite(dr.detach(dr.squared_norm(w) + dr.squared_norm(hit) + rho))
        straddles = ~visible
        norm = dr.rsqrt(dr.squared_norm(w))
        what = w * norm
        amplitude = rho * SQRT_2PI * norm
        wa, wb = rotate_inverse(q, a) / s, rotate_inverse(q, b) / s
        na, nb = dr.cross(what, wa), dr.cross(what, wb)
        e1 = e2 = e11 = e12 = e22 = dr.zeros(Float64, dr.width(p))
        with dr.suspend_grad():
            area = dr.norm(dr.cross(na, nb))
            high_x, high_y = extent * dr.norm(nb) / area, extent * dr.norm(na) / area
            low_x, low_y = -high_x, -high_y
    else:
        r = p - view.source
        axis = view.corner - view.source
        plane, depth = dr.dot(n, axis), dr.dot(n, r)
        with dr.suspend_grad():
            # Half the depth that the kappa-ellipsoid spans: its support function along the panel's normal.
            half = extent * dr.norm(s * rotate_inverse(q, n))
            near, far = depth * dr.sign(plane) - half, depth * dr.sign(plane) + half
            hidden = far <= 0
            straddles = near < 0.01 * far
            if view.panel:
                hidden |= near >= dr.abs(plane)
                straddles |= far > dr.abs(plane)
            sound = dr.isfinite(half + dr.squared_norm(r) + dr.squared_norm(1 / s) + rho)
            straddles = straddles & ~hidden | ~sound
            visible = ~hidden & ~straddles
        k = plane / dr.select(visible, depth, plane)
        hit = k * r - axis
        w = dr.select(visible, rotate_inverse(q, r) / s, Vector3d(1, 0, 0))
        length = dr.norm(w)
        what = w / length
        norm = 1 / (k * length)
        amplitude = rho * SQRT_2PI * norm
        wa, wb = rotate_inverse(q, a) * (norm / s), rotate_inverse(q, b) * (norm / s)
        na, nb = dr.cross(w, wa), dr.cross(w, wb)
        e1, e2 = 2 * dr.dot(what, wa), 2 * dr.dot(what, wb)
        e11, e12, e22 = dr.squared_norm(wa), dr.dot(wa, wb), dr.squared_norm(wb)
        with dr.suspend_grad():
            # Detector rows and columns are planes through the source; whitened, the outermost touch the kappa-sphere.
            c = dr.cross(wb, wa)
            kk = extent * extent
            quad = dr.square(dr.dot(w, c)) - kk * dr.squared_norm(c)
            low_y, high_y = _roots(quad, kk * dr.dot(na, c) / length, kk * dr.squared_norm(na) / dr.square(length))
            low_x, high_x = _roots(quad, -kk * dr.dot(nb, c) / length, kk * dr.squared_norm(nb) / dr.square(length))

    nn = dr.squared_norm(n)
    x, y = dr.dot(dr.cross(hit, b), n) / nn, dr.dot(dr.cross(a, hit), n) / nn
    mx = dr.norm(na)
    shear = dr.dot(na, nb) / dr.square(mx)
    my = dr.norm(dr.cross(na, nb)) / mx
    if widen:
        # The inverse of num's matrix is the footprint's covariance, which grows by `widen` on its diagonal.
        det, xx, yy = dr.squared_norm(dr.cross(na, nb)), dr.squared_norm(na), dr.squared_norm(nb)
        shrink = dr.rsqrt(1 + widen * (xx + yy + widen * det))
        wide_x = xx + widen * det
        amplitude = amplitude * shrink
        mx, shear, my = dr.sqrt(wide_x) * shrink, dr.dot(na, nb) / wide_x, dr.sqrt(det / wide_x)
        with dr.suspend_grad():
            grow_x, grow_y = dr.sqrt(1 + widen * det / yy), dr.sqrt(wide_x / xx)
            low_x, high_x, low_y, high_y = low_x * grow_x, high_x * grow_x, low_y * grow_y, high_y * grow_y
    # The denominator in the sheared coordinate, dx = t - shear dy.
    e22 = e22 + shear * (shear * e11 - 2 * e12)
    e12 = e12 - shear * e11
    e2 = e2 - shear * e1

    with dr.suspend_grad():
        def pixel(position, size):
            return mi.Int32(dr.clip(dr.select(visible, position, 0), 0, size))
        row_begin = pixel(dr.ceil(y + low_y - .5), view.height)
        row_end = dr.select(visible, pixel(dr.floor(y + high_y - .5) + 1, view.height), 0)
        begin, end = pixel(dr.floor(x + low_x - .5), view.width), pixel(dr.ceil(x + high_x + .5), view.width)
        row_end = dr.select(end > begin, row_end, 0)
        far_out = 1e9  # keeps the whole part of a centre far outside the image within Int32
        column = mi.Int32(dr.clip(dr.select(visible, dr.floor(x), 0), -far_out, far_out))
        row = mi.Int32(dr.clip(dr.select(visible, dr.floor(y), 0), -far_out, far_out))
        width, row_end = mi.Float(end - begin), dr.maximum(row_end, row_begin)
        area = dr.minimum(mi.Float(row_end - row_begin) * width, mi.Float(dr.pi * extent * extent / (mx * my)))
    values = (amplitude, mx, my, shear, e1, e2, e11, e12, e22, x - (Float64(column) + .5), y - (Float64(row) + .5))
    values = tuple(v if name in DOUBLE else mi.Float(v) for name, v in zip(NAMES, values))
    return Footprints(values, column, row, row_begin, row_end, width, area, straddles)


def _roots(a, b, c):
    """Roots of a x^2 - 2 b x - c = 0 for a > 0, c >= 0, without cancellation: their product is -c / a."""
    root = dr.sqrt(dr.maximum(b * b + a * c, 0))
    big = dr.select(b >= 0, b + root, b - root)
    first, second = big / a, -c / big
    return dr.minimum(first, second), dr.maximum(first, second)
