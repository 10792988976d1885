"""Alpha compositing of projected Gaussians, front to back: the image formation of 3D Gaussian Splatting and of X-Gaussian.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", ACM TOG 42 (2023), equation 3 and appendix C.
With c the radiance of a Gaussian, o its opacity and q its squared distance in standard deviations of the projected (affine)
2D Gaussian,

    alpha = min(0.99, o exp(-q / 2)), left out below 1/255
    C     = sum over Gaussians by depth  c alpha T,    T = product of (1 - alpha) of those in front

which stops before T falls below 1e-4. Depth is measured at the centre, along the panel's normal. This is not an X-ray projection;
it is the image formation of the baselines.

The image is cut into tiles of 8 x 8 pixels. Gaussians are sorted by depth, each is listed in the tiles that it touches, and
the list is sorted by tile (with Dr.Jit's stable sort). A lane composites four pixels of a tile's row. The backward pass goes
through the same lists front to back again: the light from behind a Gaussian is the finished pixel minus the light from its
front. Each list entry has its own slot for its part of the derivatives. The slots are then summed for each Gaussian, so that
results do not depend on the order of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.footprint import project
from lingo_mi.projectors.view import View

TILE, PACKET = 8, 4
LANES = TILE * TILE // PACKET  # per tile
LEAST = 1 / 255  # Kerbl et al., appendix C: smaller contributions are left out
MOST = 0.99  # appendix C: alpha is clamped
STOP = 1e-4  # appendix C: accumulated opacity of 0.9999
WIDEN = 0.3  # variance in pixels^2 that the published rasterisers add to every footprint
EXTENT = 3.33  # standard deviations at which an opacity of 1 has fallen to 1/255
NAMES = ('opacity', 'radiance', 'mx', 'my', 'shear', 'x', 'y')


@dataclass
class Discs:
    """N projected Gaussians in one view.

    Parameters
    ----------
    values : Float [N]
        Named in NAMES: q = (mx t)^2 + (my dy)^2 with t = dx + shear dy; (x, y) is the centre, in pixels from the image's corner.
    depth
        Float [N] along the panel's normal; infinite for Gaussians that are not drawn (at or behind the source).
    first, count : tuple
        UInt32 [N] each for columns and rows: the box of tiles that a Gaussian touches.
    """

    values: tuple
    depth: Any
    first: tuple
    count: tuple

    @property
    def visible(self) -> Any:
        """True if a Gaussian touches the image, Bool [N]."""
        return self.count[0] * self.count[1] > 0


def flatten(centre: Any, scale: Any, rotation: Any, opacity: Any, radiance: Any, view: View) -> Discs:
    """Project Gaussians to a view by the affine (EWA) model; differentiable in all of them and in the view's pose.

    Parameters
    ----------
    centre, scale : Point3f, Vector3f [N]
        Standard deviations.
    rotation : Vector4f [N]
        Quaternion (x, y, z, w).
    opacity, radiance : Float [N]
    """
    nothing = dr.zeros(mi.Float, dr.width(opacity))
    footprints = project((centre, scale, rotation, nothing), view, EXTENT, WIDEN)
    _, mx, my, shear, *_, x, y = footprints.values
    Float64 = type(x)
    x, y = mi.Float(x + Float64(footprints.column) + 0.5), mi.Float(y + Float64(footprints.row) + 0.5)
    values = opacity, radiance, mx, my, mi.Float(shear), x, y
    with dr.suspend_grad():
        normal = dr.normalize(dr.cross(view.u, view.v))
        if view.parallel:
            along = normal * dr.sign(dr.dot(normal, view.source))
            depth = mi.Float(dr.dot(along, mi.Vector3d(centre) - view.corner))
            drawn = ~footprints.straddles
        else:
            along = normal * dr.sign(dr.dot(normal, view.corner - view.source))
            depth = mi.Float(dr.dot(along, mi.Vector3d(centre) - view.source))
            drawn = ~footprints.straddles & (depth > 0)
        # The distance at which alpha falls below 1/255. The ellipse's box follows from the inverse of q's matrix.
        reach = dr.sqrt(2 * dr.log(dr.maximum(opacity / LEAST, 1)))
        drawn &= reach > 0
        half_y = reach / my
        half_x = reach * dr.sqrt(dr.square(1 / mx) + dr.square(mi.Float(shear) / my))
        first, count = zip(
            *(_tiles(p, h, size, drawn) for p, h, size in ((x, half_x, view.width), (y, half_y, view.height)))
        )
        depth = dr.select(drawn, depth, dr.inf)
    return Discs(values, depth, first, count)


def _tiles(position, half, size, drawn):
    """First tile and number of tiles that [position - half, position + half] touches."""

    def tile(x):
        return mi.UInt32(dr.clip(dr.select(drawn, x, 0), 0, size) / TILE)

    low, high = position - half - 0.5, position + half + 0.5  # pixel centres at + 1/2; a margin for rounding
    drawn &= (high > 0) & (low < size)
    tiles = dr.opaque(mi.UInt32, -(-size // TILE))
    first = tile(low)
    return first, dr.select(drawn, dr.minimum(tile(high) + 1, tiles) - dr.minimum(first, tiles), 0)


def composite(discs: Discs, height: int, width: int) -> Any:
    """The image of projected Gaussians, Float [height * width], row by row, over black.

    Differentiable in `discs.values`, in reverse mode only.
    """
    return dr.custom(_Composite, discs.values, (discs.depth, *discs.first, *discs.count), height, width)


class _Composite(dr.CustomOp):
    def eval(self, values, boxes, height, width):
        self.values = values
        self.lists = _Lists(boxes, height, width)
        self.packed = _pack(values)
        self.size = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height)
        if self.lists.length == 0:
            self.image = dr.zeros(mi.Float, height * width)
            return self.image
        image = dr.zeros(mi.Float, height * width)
        dr.make_opaque(image)
        dr.eval(_forward(_Place(self.lists, *self.size), self.lists.disc, self.packed, image), image)
        self.image = image
        return image

    def backward(self):
        n = dr.width(self.values[0])
        if self.lists.length == 0:
            self.set_grad_in('values', tuple(dr.zeros(mi.Float, n) for _ in NAMES))
            return
        lists = self.lists
        grad: Any = self.grad_out()
        upstream = grad + dr.zeros(mi.Float, dr.width(self.image))
        slots = [dr.zeros(mi.Float, lists.length) for _ in NAMES]
        dr.make_opaque(upstream, slots)
        dr.eval(_backward(_Place(lists, *self.size), lists, self.packed, self.image, upstream, slots), slots)
        end = dr.gather(mi.UInt32, lists.ends, lists.rank)
        begin = dr.gather(mi.UInt32, lists.ends, lists.rank - 1, lists.rank > 0)  # 0 where masked
        moments = _add_up(begin, end, slots)
        self.set_grad_in('values', _by_values(self.values, moments))

    def name(self):
        return 'alpha compositing'


class _Lists:
    """For every tile the Gaussians that touch it, front to back.

    Attributes
    ----------
    length
        Number of entries.
    disc, entry : UInt32 [length]
        Sorted by tile: the Gaussian, and the entry's number when sorted by depth.
    tile_ends : UInt32 [tiles]
        End of each tile's entries.
    ends : UInt32 [N]
        End of each Gaussian's entries when sorted by depth.
    rank : UInt32 [N]
        A Gaussian's position by depth.
    """

    def __init__(self, boxes, height, width):
        depth, first_x, first_y, count_x, count_y = boxes
        n = dr.width(depth)
        self.columns = -(-width // TILE)
        self.tiles = self.columns * -(-height // TILE)
        order = dr.argsort(depth) if n > 1 else dr.arange(mi.UInt32, n)
        self.rank = dr.empty(mi.UInt32, n)
        dr.scatter(self.rank, dr.arange(mi.UInt32, n), order, mode=dr.ReduceMode.Permute)
        touched = dr.gather(mi.UInt32, count_x * count_y, order)
        self.ends = dr.prefix_reduce(dr.ReduceOp.Add, touched, exclusive=False)
        dr.eval(order, self.rank, self.ends)
        self.length = int(self.ends[n - 1])
        if self.length == 0:
            return
        entry = dr.arange(mi.UInt32, self.length)
        rank = _owner(entry, self.ends, dr.opaque(mi.UInt32, n))
        disc = dr.gather(mi.UInt32, order, rank)
        inner = entry - dr.select(rank > 0, dr.gather(mi.UInt32, self.ends, rank - 1, rank > 0), 0)
        across = dr.maximum(dr.gather(mi.UInt32, count_x, disc), 1)
        x = dr.gather(mi.UInt32, first_x, disc) + inner % across
        y = dr.gather(mi.UInt32, first_y, disc) + inner // across
        tile = y * dr.opaque(mi.UInt32, self.columns) + x
        dr.eval(tile, disc)
        self.entry = dr.argsort(tile) if self.length > 1 else dr.arange(mi.UInt32, 1)
        self.disc = dr.gather(mi.UInt32, disc, self.entry)
        counts = dr.zeros(mi.UInt32, self.tiles)
        dr.scatter_add(counts, mi.UInt32(1), tile)
        self.tile_ends = dr.prefix_reduce(dr.ReduceOp.Add, counts, exclusive=False)
        dr.eval(self.entry, self.disc, self.tile_ends)


class _Place:
    """Positions of the lanes of all tiles: four pixels of a row each, and the range of their tile's list."""

    def __init__(self, lists, width, height):
        lane = dr.arange(mi.UInt32, lists.tiles * LANES)
        tile, inner = lane // LANES, lane % LANES
        columns = dr.opaque(mi.UInt32, lists.columns)
        x = tile % columns * TILE + inner % (TILE // PACKET) * PACKET
        y = tile // columns * TILE + inner // (TILE // PACKET)
        self.end = dr.gather(mi.UInt32, lists.tile_ends, tile)
        self.begin = dr.select(tile > 0, dr.gather(mi.UInt32, lists.tile_ends, tile - 1, tile > 0), 0)
        self.x, self.y = mi.Float(x) + 0.5, mi.Float(y) + 0.5
        self.inside = [(x + i < width) & (y < height) for i in range(PACKET)]
        self.pixel = [y * width + x + i for i in range(PACKET)]


def _pack(values):
    """The seven numbers of every Gaussian and a zero, as two packets."""
    count = dr.width(values[0])
    target, i = dr.empty(mi.Float, 8 * count), dr.arange(mi.UInt32, count)
    columns = (*(v + dr.zeros(mi.Float, count) for v in values), dr.zeros(mi.Float, count))
    for j in range(2):
        dr.scatter(target, mi.Vector4f(*columns[4 * j :][:4]), 2 * i + j, mode=dr.ReduceMode.Permute)
    dr.eval(target)
    return target


@dr.syntax
def _owner(entry, ends, count):
    """The item that an entry belongs to, by binary search in the ends of all items' ranges."""
    low, size = mi.UInt32(0), mi.UInt32(count)
    while size > 0:
        middle = low + size // 2
        if dr.gather(mi.UInt32, ends, middle) <= entry:
            low = middle + 1
            size -= size // 2 + 1
        else:
            size //= 2
    return low


def _alpha(a, b, x, y):
    """alpha of four pixels before clamping (0 below `LEAST`), t and dy."""
    opacity, mx, my, shear = a[0], a[2], a[3], b[0]
    dy = y - b[2]
    t = mi.Vector4f(x, x + 1, x + 2, x + 3) - b[1] + shear * dy
    alpha = opacity * dr.exp(-0.5 * (dr.square(mx * t) + dr.square(my * dy)))
    return dr.select(alpha >= LEAST, alpha, 0), t, dy


@dr.syntax
def _forward(place, disc, packed, image):
    begin, end, x, y, inside, pixel = place.begin, place.end, place.x, place.y, place.inside, place.pixel
    colour, through, i = mi.Vector4f(0), mi.Vector4f(1), mi.UInt32(begin)
    while (i < end) & (dr.max(through) > 0):
        g = dr.gather(mi.UInt32, disc, i)
        a, b = dr.gather(mi.Vector4f, packed, 2 * g), dr.gather(mi.Vector4f, packed, 2 * g + 1)
        alpha, _, _ = _alpha(a, b, x, y)
        colour, through, _ = _blend(colour, through, dr.minimum(alpha, MOST), a[1])
        i += 1
    for k in range(PACKET):
        dr.scatter(image, colour[k], pixel[k], inside[k])
    return i


def _blend(colour, through, alpha, radiance):
    """Colour and transmittance behind a Gaussian, and its weight alpha T. A finished pixel has T = 0."""
    left = through * (1 - alpha)
    weight = dr.select(left >= STOP, alpha * through, 0)
    return colour + weight * radiance, dr.select(left >= STOP, left, 0), weight


@dr.syntax
def _backward(place, lists, packed, image, upstream, slots):
    begin, end, x, y, inside, pixel = place.begin, place.end, place.x, place.y, place.inside, place.pixel
    disc, entry = lists.disc, lists.entry
    colour, through, i = mi.Vector4f(0), mi.Vector4f(1), mi.UInt32(begin)
    total = mi.Vector4f(*(dr.gather(mi.Float, image, pixel[k], inside[k]) for k in range(PACKET)))
    grad = mi.Vector4f(*(dr.gather(mi.Float, upstream, pixel[k], inside[k]) for k in range(PACKET)))
    while (i < end) & (dr.max(through) > 0):
        g = dr.gather(mi.UInt32, disc, i)
        a, b = dr.gather(mi.Vector4f, packed, 2 * g), dr.gather(mi.Vector4f, packed, 2 * g + 1)
        raw, t, dy = _alpha(a, b, x, y)
        alpha, before = dr.minimum(raw, MOST), mi.Vector4f(through)
        colour, through, weight = _blend(colour, through, alpha, a[1])
        # dC / dalpha: the Gaussian's own light minus the light from behind that it hides.
        by_alpha = grad * (before * a[1] - (total - colour) / (1 - alpha))
        u = dr.select((weight > 0) & (raw < MOST), by_alpha * alpha, 0)
        used = dr.max(weight) > 0
        where = dr.gather(mi.UInt32, entry, i)
        s0, s1, s2 = dr.sum(u), dr.sum(u * t), dr.sum(u * t * t)
        parts = (dr.sum(grad * weight), s0, s1, s2, s0 * dy, s1 * dy, s0 * dy * dy)
        for k in range(len(slots)):
            dr.scatter_add(slots[k], parts[k], where, used, mode=dr.ReduceMode.Local)
        i += 1
    return i


@dr.syntax
def _add_up(begin, end, slots):
    i, sums = mi.UInt32(begin), [mi.Float(0) for _ in slots]
    while i < end:
        for k in range(len(slots)):
            sums[k] += dr.gather(mi.Float, slots[k], i)
        i += 1
    return sums


def _by_values(values, moments):
    """Derivatives by the seven numbers, from the derivative by the radiance and moments of alpha dL/dalpha in t and dy."""
    light, u, ut, utt, uy, uty, uyy = moments
    opacity, _, mx, my, shear, _, _ = values
    along = dr.square(mx) * ut
    return (
        dr.select(opacity > 0, u / dr.maximum(opacity, 1e-30), 0),
        light,
        -mx * utt,
        -my * uyy,
        -dr.square(mx) * uty,
        along,
        shear * along + dr.square(my) * uy,
    )
