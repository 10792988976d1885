"""Joseph's projector and its exact transpose before an upright panel, fast enough to iterate with (Dr.Jit, llvm or cuda).

Joseph, "An improved algorithm for reprojecting rays through pixel images", IEEE TMI 1 (1982): a ray's main axis is x or y,
whichever has more slices of voxels on its way. The ray is sampled where it meets the slices of voxel centres along this axis, by
bilinear interpolation in each slice. If the main axis is x, the weight of voxel (i, j, k) in the ray of pixel (u, v) is

    a = L(u, v) hat(y(u, i) - j) hat(z(u, v, i) - k),    hat(s) = max(0, 1 - |s|)

with L the path per slice. As in `grid`, the edge value is held in the outer half voxel, where the box ends. The panel's
columns are parallel to z, so y depends on the column alone, and the few pixels with hats that cover a given voxel can be listed.
So both directions are gathers with the same weights.

Source and panel may lie anywhere else, and differ from view to view: circles, helices, shifts. The panel may be curved, since its
columns are still parallel to z. `tilted_joseph` is for all others.
"""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.rays import Rays
from lingo_mi.projectors import bent
from lingo_mi.projectors.stack import Gathered, hat, lanes, sampled, span
from lingo_mi.projectors.upload import uploaded

COLUMN = 8  # floats per detector column
RUN = 8  # voxels per lane of the transpose
ROWS = 4  # most rows of the panel that its innermost loop unrolls
TILT = 1e-3  # pixels that corners of an upright panel may be off
MOST_ROWS = 64  # rows of a small panel that rays of one voxel may meet


def column_table(geometry: Geometry) -> np.ndarray:
    """The rays of every detector column, in voxel indices: float32 [view, u, 8].

    Let m be the index along the main axis. The transverse index is `a + b m`. The share of the way from the source to the
    panel is `c + e m` (parallel: 1). The path per slice is sqrt(g + h dz^2) mm, with dz the height of the pixel above the
    source, in voxels. The columns are a, b, c, e, g, h, whether the main axis is y, and 0.
    """
    rays, n_u = geometry.rays(curved=True), geometry.nDetector[1]
    voxel = np.array(geometry.grid.spacing[:2])
    first = np.array(geometry.grid.centre[:2]) + (voxel - geometry.grid.size[:2]) / 2
    column = np.arange(n_u)[:, None] + 0.5
    X = column if rays.curve is None else rays.curve.columns(column[:, 0])[..., None]
    pixel = rays.corner[:, None, :2] + X * rays.u[:, None, :2]  # [view, u, 2], mm
    source = rays.source[:, None, :2]
    if rays.curve is not None:
        pixel = source + rays.curve.share(column[:, 0])[..., None] * (pixel - source)
    direction = np.broadcast_to(source, pixel.shape) if rays.parallel else pixel - source
    start = pixel if rays.parallel else source
    index, step = (start - first) / voxel, direction / voxel
    along_y = np.abs(step[..., 1]) > np.abs(step[..., 0])  # in voxels: no slice is stepped over

    def main(x):
        return np.where(along_y, x[..., 1], x[..., 0])

    def other(x):
        return np.where(along_y, x[..., 0], x[..., 1])

    e = 1 / main(step)
    c = -main(np.broadcast_to(index, step.shape)) * e
    b = other(step) * e
    a = other(np.broadcast_to(index, step.shape)) + other(step) * c
    path = main(np.broadcast_to(voxel, step.shape)) / main(direction)
    g, h = path**2 * (direction**2).sum(-1), (path * geometry.grid.spacing[2]) ** 2
    if rays.parallel:
        c, e, h = np.ones_like(c), np.zeros_like(c), np.zeros_like(c)
    return np.stack([a, b, c, e, g, h, along_y, np.zeros_like(a)], -1).astype(np.float32)


def row_table(geometry: Geometry) -> np.ndarray:
    """Heights of the source, of the first row over it, and between rows, in voxels: float32 [view, 3]."""
    rays, voxel = geometry.rays(curved=True), geometry.grid.spacing[2]
    first = geometry.grid.centre[2] + (voxel - geometry.grid.size[2]) / 2
    source = 0.0 * rays.v[:, 2] if rays.parallel else (rays.source[:, 2] - first) / voxel
    top = (rays.corner[:, 2] + rays.v[:, 2] / 2 - first) / voxel
    return np.stack([source, top - source, rays.v[:, 2] / voxel], -1).astype(np.float32)


def _is_upright(geometry: Geometry) -> bool:
    """Return whether every view's columns are parallel to z and its rows, and a parallel beam, perpendicular to it."""
    rays, (n_v, n_u) = geometry.rays(curved=True), geometry.nDetector
    pixel = np.minimum(np.linalg.norm(rays.u, axis=1), np.linalg.norm(rays.v, axis=1))
    off = np.abs(rays.u[:, 2]) * n_u + np.linalg.norm(rays.v[:, :2], axis=1) * n_v
    if rays.parallel:
        off = off + np.abs(rays.source[:, 2]) * np.linalg.norm(geometry.grid.size[:2])
    return bool((off < TILT * pixel).all())


def _rows_of_voxel(geometry):
    """The largest number of rows with hats that cover a voxel; infinity if a voxel lies beside the source or behind it.

    A curved panel stands before the flat one that it touches, where its rows are not further apart in voxels.
    """
    rays = geometry.rays(curved=True)
    nearest = _nearest(rays, geometry)
    if nearest <= 0:
        return np.inf
    return np.ceil(2 * geometry.grid.spacing[2] / (nearest * np.abs(rays.v[:, 2]).min()) + 1e-3)


def _nearest(rays: Rays, geometry):
    """The smallest share of the way from the source to the panel at which a voxel lies; parallel: 1."""
    if rays.parallel:
        return 1.0
    half, middle = np.array(geometry.grid.size[:2]) / 2, np.array(geometry.grid.centre[:2])
    corners = middle + half * [(-1, -1), (-1, 1), (1, -1), (1, 1)]
    normal = np.cross(rays.u, rays.v)[:, :2]
    to_panel = ((rays.corner - rays.source)[:, :2] * normal).sum(1)
    return (((corners - rays.source[:, None, :2]) * normal[:, None]).sum(2) / to_panel[:, None]).min()


class Joseph(Gathered):
    """The matrix A of a scan with an upright panel: see `Gathered`.

    On the device: `columns` and `rows`, see `column_table` and `row_table`; `matrices`, see `_column_matrix`; `bends`, see
    `bent.tables`. `margin` rows of zeros above and below images are at least as many as the rows with hats that cover a voxel.

    Parameters
    ----------
    valid : ndarray or None
        Bool [view, v, u]; None: all.

    Raises
    ------
    InputError
        For a scan that it does not serve (see `serves`), or a volume of 2^32 voxels or more.
    """

    ARRAYS = ('columns', 'rows', 'matrices', 'bends', 'valid')
    SETTINGS = (*Gathered.SETTINGS, 'margin')

    def __init__(self, geometry: Geometry, valid: np.ndarray | None = None):
        super().__init__(geometry, valid)
        if not self.serves(geometry):
            raise InputError(
                'this projector needs an upright panel, and a source that is not beside or inside the volume'
            )
        rows = int(_rows_of_voxel(geometry))
        self.margin = rows if rows <= ROWS else -(-rows // ROWS) * ROWS
        self.columns, self.rows = (uploaded(table(geometry)) for table in (column_table, row_table))
        self.matrices = uploaded(self._column_matrix())
        _, self.bends = bent.tables(geometry.rays(curved=True).curve, self.panel[1])

    @classmethod
    def serves(cls, geometry: Geometry) -> bool:
        """Return whether this projector can project a scan: the panel must be upright, and all of the volume well before the
        source."""
        return _is_upright(geometry) and _rows_of_voxel(geometry) <= max(MOST_ROWS, 2 * geometry.nDetector[0])

    def of_slab(self, slab: Geometry) -> Joseph:
        """The matrix of the same scan for other slices of its voxels. slab: see `Geometry.slab`."""
        out = copy(self)
        out.geometry, out.size, out.rows = slab, slab.grid.shape, uploaded(row_table(slab))
        return out

    def _column_matrix(self):
        """(x w, w) of the projected column of a voxel from its indices (i, j, 1): float32 [view, 6]."""
        return self.geometry.voxel_matrices()[:, [0, 2]][:, :, [0, 1, 3]].reshape(-1, 6).astype(np.float32)

    def _integrate(self, volume, view, u, v):
        return _integrate(volume, self, view, u, v)

    def _weighted(self, images, block, ones):
        return _weighted(images, block.numbers, self, ones)

    def _collect(self, weighted, block, ones):
        return _collect(weighted, block.numbers, block.count, self, ones)


def _rows(rows, view):
    return [dr.gather(mi.Float, rows, view * 3 + i) for i in range(3)]


def _column(columns, index):
    return [dr.gather(mi.Float, columns, index * COLUMN + i) for i in range(7)]


@dr.syntax
def _integrate(data, A: Joseph, view, column, row):
    """(A x, A 1) of rays, one per lane."""
    nx, ny, nz = A.size
    a, b, c, e, g, h, along_y = _column(A.columns, view * A.panel[1] + column)
    source, top, step = _rows(A.rows, view)
    on_y = along_y > 0
    height = dr.fma(mi.Float(row), step, top)
    n_main, n_other = dr.select(on_y, mi.Float(ny), mi.Float(nx)), dr.select(on_y, mi.Float(nx), mi.Float(ny))
    s_main, s_other = dr.select(on_y, mi.UInt(nz), mi.UInt(ny * nz)), dr.select(on_y, mi.UInt(ny * nz), mi.UInt(nz))
    low, high = span(a, b, n_other)
    z_low, z_high = span(dr.fma(c, height, source), e * height, mi.Float(nz))
    m = dr.floor(dr.clip(dr.maximum(low, z_low), 0, n_main))
    last = dr.ceil(dr.clip(dr.minimum(high, z_high), -1, n_main - 1))
    total, count = mi.Float(0), mi.Float(0)
    while m <= last:
        y, t = dr.fma(b, m, a), dr.fma(e, m, c)
        z = dr.fma(t, height, source)
        inside = (y >= -0.5) & (y <= n_other - 0.5) & (z >= -0.5) & (z <= nz - 0.5) & (t > 0)
        total += sampled(data, inside, mi.UInt(m) * s_main, (y, z), (n_other, nz), (s_other, mi.UInt(1)))
        count += dr.select(inside, 1.0, 0.0)
        m += 1
    path = dr.sqrt(dr.fma(h, height * height, g))
    return path * total, path * count


def _weighted(images, chosen, A: Joseph, ones):
    """Images times the path per slice, with `margin` rows of zeros above and below: mi.Float [block, u, row].

    See `Gathered`.
    """
    (n_v, n_u), columns, margin = A.panel, A.columns, A.margin
    pitch = n_v + 2 * margin
    index = dr.arange(mi.UInt, dr.width(images) // n_v * pitch)
    column = index // pitch
    row = mi.Int(index - column * pitch) - margin
    inside = (row >= 0) & (row < n_v)
    block = column // n_u
    view = dr.gather(mi.UInt, chosen, block)
    u = column - block * n_u
    _, top, step = _rows(A.rows, view)
    height = dr.fma(mi.Float(row), step, top)
    g, h = (dr.gather(mi.Float, columns, (view * n_u + u) * COLUMN + i) for i in (4, 5))
    pixel = mi.UInt(dr.clip(row, 0, n_v - 1))
    inside &= A.used(view, u, pixel)
    path = dr.select(inside, dr.sqrt(dr.fma(h, height * height, g)), 0)
    value = path * dr.select(inside, dr.gather(mi.Float, images, column * n_v + pixel), 0)
    return dr.ravel(mi.Vector2f(value, path)) if ones else value


def _on_arc(low, high, numbers):
    """Ends of a shadow along u, on the curved panel. numbers: see `bent.numbers_of`."""
    return bent.column_of(numbers, low), bent.column_of(numbers, high)


@dr.syntax
def _collect(weighted, chosen, n_views, A: Joseph, ones):
    """See `Gathered`. A lane computes only once what does not depend on z."""
    (nx, ny, nz), (n_v, n_u), margin = A.size, A.panel, A.margin
    columns, rows, matrices = A.columns, A.rows, A.matrices
    (voxels, exists), (x, y, z0), stride = lanes(A.size, RUN)
    run = len(voxels)
    pitch, chunks = n_v + 2 * margin, -(-margin // ROWS)
    sums = [[mi.Float(0) for _ in range(2 if ones else 1)] for _ in range(run)]
    block = mi.UInt(0)
    while block < n_views:
        view = dr.gather(mi.UInt, chosen, block)
        r = [dr.gather(mi.Float, matrices, view * 6 + i) for i in range(6)]
        source, top, step = _rows(rows, view)
        inv_step = dr.rcp(step)
        # The columns with rays that pass within one voxel along x or y.
        top_u = dr.fma(r[0], x, dr.fma(r[1], y, r[2]))
        bottom = dr.fma(r[3], x, dr.fma(r[4], y, r[5]))
        spots = [(top_u + s * r[i]) * dr.rcp(dr.maximum(bottom + s * r[i + 3], 1e-6)) for i in (0, 1) for s in (-1, 1)]
        low = dr.minimum(dr.minimum(spots[0], spots[1]), dr.minimum(spots[2], spots[3]))
        high = dr.maximum(dr.maximum(spots[0], spots[1]), dr.maximum(spots[2], spots[3]))
        low, high = (low, high) if A.bends is None else _on_arc(low, high, bent.numbers_of(A.bends, view))
        u = dr.ceil(dr.clip(low - 0.501, 0, n_u))
        u_last = dr.floor(dr.clip(high - 0.499, -1, n_u - 1))
        while u <= u_last:
            a, b, c, e, g, h, along_y = _column(columns, view * n_u + mi.UInt(u))
            on_y = along_y > 0
            m = dr.select(on_y, y, x)
            t = dr.fma(e, m, c)
            weight = hat(dr.fma(b, m, a), dr.select(on_y, x, y), dr.select(on_y, mi.Float(nx), mi.Float(ny)))
            weight = dr.select(t > 0, weight, 0)
            # Heights go from row to row by `slope` voxels; z meets the panel at the row `middle`.
            inv, slope = dr.rcp(dr.maximum(t, 1e-6)), t * step
            middle, reach = ((z0 - source) * inv - top) * inv_step, dr.abs(inv * inv_step)
            column = (block * n_u + mi.UInt(u)) * pitch + margin
            for s in range(run):
                centre = dr.fma(inv * inv_step, s * stride, middle)
                row = dr.ceil(dr.clip(centre - reach, -margin, n_v))
                chunk = 0 if chunks == 1 else mi.UInt(0)
                while chunk < chunks:
                    for i in range(ROWS if chunks > 1 else margin):
                        offset = (row + i - centre) * slope
                        if s == 0 or s == (nz - 1) // stride:
                            w = weight * hat(z0 + s * stride + offset, z0 + s * stride, nz)
                        else:
                            w = weight * dr.maximum(1 - dr.abs(offset), 0)
                        here = mi.UInt(mi.Int(column) + mi.Int(row) + i)
                        p = dr.gather(mi.Vector2f, weighted, here) if ones else [dr.gather(mi.Float, weighted, here)]
                        sums[s] = [dr.fma(w, p[j], sums[s][j]) for j in range(2 if ones else 1)]
                    row += 0 if chunks == 1 else ROWS
                    chunk += 1
            u += 1
        block += 1
    return (voxels, exists), sums
