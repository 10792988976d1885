r"""The exact footprint of a Gaussian on a detector.

For a ray :math:`o + tD` and a Gaussian (p, R, s, rho), whitened by :math:`W = \mathrm{diag}(1/s) R^T` to
:math:`w = W(p - o)`, :math:`d = WD`, the line integral is

.. math::  \rho \sqrt{2\pi} \, |D| / |d| \; \exp(-\tfrac12 |w \times d|^2 / |d|^2).

On a flat detector :math:`D = k(p - o) + \delta x\, a + \delta y\, b`. Here a and b are the pixel steps, and (dx, dy) is the
pixel position relative to the projected centre. The constant term of :math:`w \times d` vanishes, so there is no cancellation
near the centre:

    |w x d|^2 = |dx na + dy nb|^2             na = w x Wa,  nb = w x Wb
    |d|^2     = |k w + dx Wa + dy Wb|^2

Both are divided by (k|w|)^2, and the first is sheared to a sum of two squares, t = dx + shear dy:

    num = (mx t)^2 + (my dy)^2
    den = 1 + e1 t + e2 dy + e11 t^2 + 2 e12 t dy + e22 dy^2
    integral = |D| amplitude den^(-1/2) exp(-num / (2 den))

The sum of squares keeps a needle's footprint accurate in float32. For a parallel beam den = 1. The eleven numbers of a
Gaussian (amplitude, mx, my, shear, e1 ... e22, and the centre) are computed in float64: differences of world coordinates
lose digits, and the cost is negligible beside the cost of the pixels. Shear and centre are also stored in float64, because for a
needle across the image t cancels down to the needle's width. The others are stored in float32.

The footprint at the cut-off of kappa standard deviations is the conic |w x d| <= kappa |d|. It is an ellipse if the
kappa-ellipsoid lies between source and detector. Other Gaussians are left to `segment`.

Of a curved detector, this is the footprint on the flat one that it touches, with the roles of rows and columns exchanged: its
columns are straight lines there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.backprop import Cuts
from lingo_mi.projectors.bent import Bend
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.rotation import rotate_inverse, rows_of
from lingo_mi.projectors.view import View

SQRT_2PI = 2.5066282746310002

# Names of the differentiable numbers, in the order in which the kernels keep them.
NAMES = ('amplitude', 'mx', 'my', 'shear', 'e1', 'e2', 'e11', 'e12', 'e22', 'x', 'y')
DOUBLE = 'shear', 'x', 'y'


@dataclass
class Footprints:
    """Footprints of N Gaussians in one view.

    Parameters
    ----------
    values : tuple
        The eleven differentiable numbers named in NAMES, [N] each: Float, but Float64 for those in DOUBLE; (x, y) is the
        projected centre, in pixels from the centre of pixel (column, row), which contains it.
    column, row : Int32 [N]
    row_begin, row_end : Int32 [N]
        Rows of the footprint, clipped to the image; an empty range if there are none. On a curved detector: its columns; (column,
        row) and (x, y) are then (Y, X) of `geometry.curve`.
    width : Float [N]
        Pixels across the widest row, for balancing work.
    area : Float [N]
        Covered pixels: the pixels of the ellipse or of the box, whichever are fewer.
    straddles : Bool [N]
        Gaussians without a footprint, which `segment` must integrate; also invalid ones (a number that is not finite, or a zero
        scale or quaternion).
    bend : Bend or None
        The view's.
    """

    values: tuple
    column: Any
    row: Any
    row_begin: Any
    row_end: Any
    width: Any
    area: Any
    straddles: Any
    bend: Bend | None = None

    @property
    def visible(self) -> Any:
        """True if a Gaussian has pixels in the image, Bool [N]."""
        return self.row_end > self.row_begin


@full_float64()
def project(gaussians: Sequence, view: View, extent: float, widen: float = 0.0, cut: Cuts | None = None) -> Footprints:
    """Footprints of N Gaussians in a view.

    Parameters
    ----------
    gaussians : Sequence
        Centre Point3f [N]; scale Vector3f [N], standard deviations; rotation Vector4f [N], quaternion (x, y, z, w), normalised
        here; density Float [N], value at the centre. The functional API calls them means, scales, quaternions and density.
    extent : float
        Cut-off in standard deviations.
    widen : float
        Variance, in pixels^2, of a round Gaussian to convolve footprints with (|d|^2 taken as constant).
    cut : Cuts or None
        Cuts at which `pass_on` backpropagates in parts.
    """
    centre, scale, rotation, density = gaussians
    cut = cut or Cuts(False)
    Vector3d = mi.Vector3d
    Float64: Any = dr.value_t(Vector3d)
    p, s, rho = Vector3d(centre), Vector3d(scale), Float64(density)
    Vector4d: Any = dr.float64_array_t(type(rotation))
    rows = cut(*rows_of(Vector4d(rotation), Vector3d))
    inverse = 1 / s
    bend, height, width = view.bend, view.height, view.width
    a, b = view.u, view.v
    if bend is not None:
        a, b, height, width = b, a, width, height
    n = dr.cross(a, b)

    if view.parallel:
        to_plane = p - view.corner
        depth = dr.dot(n, view.source)
        hit = to_plane - view.source * (dr.dot(n, to_plane) / depth)
        across = (rotate_inverse(rows, step) for step in (a, b))
        w, inverse, *across = cut(inverse * rotate_inverse(rows, view.source), inverse, *across)
        visible = dr.isfinite(dr.detach(dr.squared_norm(w) + dr.squared_norm(hit) + rho))
        straddles = ~visible
        norm = dr.rsqrt(dr.squared_norm(w))
        what = w * norm
        norm, na, nb = cut(norm, *(dr.cross(what, inverse * step) for step in across))
        e1 = e2 = e11 = e12 = e22 = dr.zeros(Float64, dr.width(p))
        factor = norm
    else:
        r = p - view.source
        axis = view.corner - view.source
        plane = dr.dot(n, axis)
        with dr.suspend_grad():
            # Half the depth that the kappa-ellipsoid spans: its support function along the panel's normal.
            support = s * rotate_inverse(rows, n)
            depth, half = dr.dot(n, r) * dr.sign(plane), extent * dr.norm(support)
            near, far = depth - half, depth + half
            quad = near * far
            hidden = far <= 0
            straddles = near < 0.01 * far
            sound = dr.isfinite(half + dr.squared_norm(r) + dr.squared_norm(inverse) + rho)
            straddles = straddles & ~hidden | ~sound
            visible = ~hidden & ~straddles
        r = dr.select(visible, r, n)  # a safe value for invisible ones, to avoid division by zero below
        depth = dr.dot(n, r)
        k = plane / depth
        hit = k * r - axis
        across = (rotate_inverse(rows, step) for step in (a, b))
        w, inverse, k, depth, hit, *across = cut(inverse * rotate_inverse(rows, r), inverse, k, depth, hit, *across)
        length = dr.norm(w)
        norm = 1 / (k * length)
        wa, wb = (inverse * norm * step for step in across)
        w, wa, wb, norm, length = cut(w, wa, wb, norm, length)
        na, nb = dr.cross(w, wa), dr.cross(w, wb)
        what = w / length
        e1, e2 = 2 * dr.dot(what, wa), 2 * dr.dot(what, wb)
        e11, e12, e22 = dr.squared_norm(wa), dr.dot(wa, wb), dr.squared_norm(wb)
        factor = length * dr.square(norm)

    amplitude = rho * SQRT_2PI * norm
    # |na x nb|, from the determinant of W: for a needle, na and nb are nearly parallel and their product would cancel.
    det = factor * dr.abs(depth) * inverse.x * inverse.y * inverse.z
    aa, ab, bb = dr.squared_norm(na), dr.dot(na, nb), dr.squared_norm(nb)
    with dr.suspend_grad():
        if view.parallel:
            high_x, high_y = extent * dr.sqrt(bb) / det, extent * dr.sqrt(aa) / det
            low_x, low_y = -high_x, -high_y
        else:
            # Detector rows and columns are planes through the source. The outermost, whitened, touch the kappa-sphere.
            reach = extent * dr.abs(depth) / det
            offset = extent * reach
            low_y, high_y = _roots(quad, -offset * dr.dot(na, support), dr.square(reach) * aa)
            low_x, high_x = _roots(quad, offset * dr.dot(nb, support), dr.square(reach) * bb)
    if widen:
        # The inverse of num's matrix is the footprint's covariance, which grows by `widen` on its diagonal.
        wide = aa + widen * dr.square(det)
        shrink = dr.rsqrt(1 + widen * (bb + wide))
        with dr.suspend_grad():
            grow_x, grow_y = dr.sqrt(1 + widen * dr.square(det) / bb), dr.sqrt(wide / aa)
            low_x, high_x, low_y, high_y = low_x * grow_x, high_x * grow_x, low_y * grow_y, high_y * grow_y
        amplitude, aa = amplitude * shrink, wide
    root = dr.sqrt(aa)
    mx, my, shear = root, det / root, ab / aa
    if widen:
        mx = mx * shrink
    nn = dr.squared_norm(n)
    x, y = dr.dot(hit, dr.cross(b, n) / nn), dr.dot(hit, dr.cross(n, a) / nn)
    # The denominator in the sheared coordinate, dx = t - shear dy.
    e22 = e22 + shear * (shear * e11 - 2 * e12)
    e12 = e12 - shear * e11
    e2 = e2 - shear * e1
    if widen and not view.parallel:
        # If |d|^2 is not nearly constant over the widened footprint, num <= kappa^2 den may not be an ellipse.
        with dr.suspend_grad():
            bent = extent * extent * dr.maximum(e11 / dr.square(mx), e22 / dr.square(my)) > 0.5
            straddles |= visible & bent
            visible &= ~bent

    with dr.suspend_grad():

        def pixel(position, size):
            return mi.Int32(dr.clip(dr.select(visible, position, 0), 0, size))

        low_x, high_x, low_y, high_y = x + low_x, x + high_x, y + low_y, y + high_y
        if bend is not None:
            low_y, high_y = bend.column_of(low_y), bend.column_of(high_y)
            low_x, high_x = bend.rows_of(low_x, high_x)
        row_begin = pixel(dr.ceil(low_y - 0.5), height)
        row_end = dr.select(visible, pixel(dr.floor(high_y - 0.5) + 1, height), 0)
        begin, end = pixel(dr.floor(low_x - 0.5), width), pixel(dr.ceil(high_x + 0.5), width)
        row_end = dr.select(end > begin, row_end, 0)
        far_out = 1e9  # keeps the whole part of a centre far outside the image within Int32
        column = mi.Int32(dr.clip(dr.select(visible, dr.floor(x), 0), -far_out, far_out))
        row = mi.Int32(dr.clip(dr.select(visible, dr.floor(y), 0), -far_out, far_out))
        widest, row_end = mi.Float(end - begin), dr.maximum(row_end, row_begin)
        area = dr.minimum(mi.Float(row_end - row_begin) * widest, mi.Float(dr.pi * extent * extent / (mx * my)))
    values = (amplitude, mx, my, shear, e1, e2, e11, e12, e22, x - (Float64(column) + 0.5), y - (Float64(row) + 0.5))
    values = tuple(v if name in DOUBLE else mi.Float(v) for name, v in zip(NAMES, values))
    return Footprints(values, column, row, row_begin, row_end, widest, area, straddles, bend)


def _roots(a, b, c):
    """Roots of a x^2 - 2 b x - c = 0 for a > 0, c >= 0, without cancellation: their product is -c / a."""
    root = dr.sqrt(dr.maximum(b * b + a * c, 0))
    big = dr.select(b >= 0, b + root, b - root)
    first, second = big / a, -c / big
    return dr.minimum(first, second), dr.maximum(first, second)
