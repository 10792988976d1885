"""The loss of a fit: L1, SSIM and error of the gradient of a projection, total variation of a cube of voxels.

SSIM's window is separable, so four kernels suffice: filter along columns; filter along rows and compare; and the two
adjoint filters. In each kernel, a lane computes TILE consecutive pixels of a line from TILE + 2 REACH taps in registers.
The four maps that SSIM filters are one packet per pixel. Packets between column and row filters are stored transposed,
so that neighbouring lanes always read neighbouring packets.

Line integrals can be large. At 10, E[x^2] - mu^2 has a rounding error above C2 = 9e-4, SSIM's constant. Therefore all
values are taken relative to a nearby origin:

    a filter       takes its taps relative to the line's middle pixel, which lies in all of its windows; the variance of
                   a window is the mean variance of its columns plus the variance of the columns' means
    between them   means are stored relative to their *tile's origin*, the middle pixel of TILE x TILE pixels
    the adjoint    filters linear functions of the two images, e + g (y - y0) - h (x - x0), with the same origins; for the
                   next tile, the step between the origins is added
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.errors import InputError
from lingo_mi.metrics.quality import C1, C2, WINDOW

TILE = 8
REACH = len(WINDOW) // 2
TAPS = range(-REACH, TILE + REACH)


def combined(
    image: Any,
    truth: Any,
    height: int,
    width: int,
    lambda_ssim: float = 0.25,
    lambda_gradient: float = 0.0,
    lambda_l1: float = 1.0,
) -> Any:
    """lambda_l1 L1 + lambda_ssim (1 - SSIM) + lambda_gradient `gradient_error` of an image and its truth, both Float
    [height * width], row by row.

    L1 is the mean absolute error, its subgradient is 0 where the two agree. SSIM is by Wang et al. (IEEE TIP 2004) in the form
    of 3D Gaussian Splatting: a Gaussian window of 11 x 11 pixels, sigma 1.5, zeros around the images, full scale 1,
    C1 = 0.01^2, C2 = 0.03^2, biased variances. Differentiable in the image, in reverse mode; the truth is a constant. Raises
    InputError if an image has another number of pixels.
    """
    _check_size('image', image, height, width)
    _check_size('truth', truth, height, width)
    loss = dr.custom(
        _Photometric, image, dr.detach(truth), height, width, lambda_l1, lambda_ssim, dr.grad_enabled(image)
    )
    if lambda_gradient > 0:
        loss += lambda_gradient * gradient_error(image, truth, height, width)
    return loss


def gradient_error(image: Any, truth: Any, height: int, width: int) -> Any:
    """Root mean square of the gradient of image - truth, both Float [height * width], row by row.

    The gradient consists of differences of neighbouring pixels along rows and columns; there are none across the edge.
    Backprojection blurs: of a structure of spatial frequency w, one step down the squared difference restores a share that falls
    as 1 / w. FDK filters projections with w before; here the difference is squared with the weight w^2, so that fine structures
    are restored as fast as coarse ones. Differentiable in the image, in reverse mode; the truth is a constant.

    Raises
    ------
    InputError
        If an image has another number of pixels.
    """
    _check_size('image', image, height, width)
    _check_size('truth', truth, height, width)
    return dr.custom(_GradientError, image, dr.detach(truth), height, width)


def tv(volume: Any, shape: tuple[int, int, int]) -> Any:
    """Mean absolute difference of neighbouring voxels along the three axes.

    Subgradient 0 where neighbours agree; 0 for a single voxel. Differentiable in reverse mode.

    Parameters
    ----------
    volume : Float [nz * ny * nx]
        x fastest.
    shape : tuple[int, int, int]
        (nz, ny, nx); an axis of one voxel has no differences.

    Raises
    ------
    InputError
        If the volume has another number of voxels.
    """
    _check_size('volume', volume, *shape)
    return dr.custom(_TotalVariation, volume, tuple(shape))


def _check_size(what, array, *shape):
    if dr.width(array) != math.prod(shape):
        raise InputError(f'the {what} has {dr.width(array)} values, not {" x ".join(map(str, shape))}')


class _Photometric(dr.CustomOp):
    """weight_l1 L1 + weight_ssim (1 - SSIM)."""

    def eval(self, image, truth, height, width, weight_l1, weight_ssim, derivative):
        dr.eval(image, truth)
        scale = 1 / (height * width)
        self.weights = dr.opaque(mi.Float, weight_l1 * scale), dr.opaque(mi.Float, weight_ssim * scale)
        self.tiles = _Tiles(image, truth, height, width)
        loss_l1, columns = self.tiles.columns()
        dr.eval(loss_l1, columns)
        loss_ssim, self.slopes = self.tiles.rows(columns, derivative)
        dr.eval(loss_ssim, self.slopes)
        return self.weights[0] * dr.sum(loss_l1) + self.weights[1] * dr.sum(loss_ssim)

    def backward(self):
        slopes = self.tiles.rows_adjoint(self.slopes)
        dr.eval(slopes)
        upstream: Any = self.grad_out()
        dr.make_opaque(upstream)
        self.set_grad_in('image', self.tiles.columns_adjoint(slopes, *(w * upstream for w in self.weights)))

    def name(self):
        return 'photometric loss'


class _Tiles:
    """The four filters of a pair of images."""

    def __init__(self, image, truth, height, width):
        self.image, self.truth, self.height, self.width = image, truth, height, width
        self.down, self.across = -(-height // TILE), -(-width // TILE)  # tiles
        self.padded_height, self.padded_width = self.down * TILE, self.across * TILE

    def columns(self):
        """Filter along columns. Returns sums of |x - y|, and per pixel (mean of x, mean of y, variance, covariance).

        The variance is the sum of both images' variances, which is all that SSIM needs.
        """
        lane = dr.arange(mi.Int32, self.down * self.padded_width)
        tile, column = lane // self.padded_width, lane % self.padded_width
        x, y = self._pixels(tile, column, TAPS)
        x0, y0 = x[REACH + TILE // 2], y[REACH + TILE // 2]
        loss, taps = mi.Float(0), []
        for k, u, v in zip(TAPS, x, y):
            if 0 <= k < TILE:
                loss += dr.abs(u - v)
            taps.append(_moments(u - x0, v - y0))
        ox, oy = self._origin(tile, column // TILE)
        target = dr.empty(mi.Float, 4 * self.padded_width * self.padded_height)
        for k, m in enumerate(_blur(taps)):
            mx, my, variance, covariance = _central(*m)
            packet = mi.Vector4f(mx + (x0 - ox), my + (y0 - oy), variance, covariance)
            dr.scatter(target, packet, column * self.padded_height + tile * TILE + k, mode=dr.ReduceMode.Permute)
        return loss, target

    def rows(self, columns, derivative):
        """Filter along rows; returns sums of 1 - SSIM, and per pixel SSIM's derivative as the packet (e, g, h, 0)."""
        tile, row, taps, origins = self._row(columns, self.padded_height)
        middle = taps[REACH + TILE // 2]
        x0, y0 = middle.x, middle.y
        moments = []
        for k, m in zip(TAPS, taps):
            dx, dy = self._step(origins, k)
            x, y, squares, product = _moments(m.x + (dx - x0), m.y + (dy - y0))
            moments.append((x, y, squares + m.z, product + m.w))
        ox, oy = origins[1]
        loss = mi.Float(0)
        target = dr.empty(mi.Float, 4 * self.padded_width * self.height if derivative else 0)
        for k, m in enumerate(_blur(moments)):
            mx, my, variance, covariance = _central(*m)
            inside = tile * TILE + k < self.width
            dissimilarity, slopes = _compare(mx + x0, my + y0, ox, oy, variance, covariance)
            loss += dr.select(inside, dissimilarity, 0)
            if derivative:
                dr.scatter(
                    target,
                    dr.select(inside, slopes, 0),
                    (tile * TILE + k) * self.height + row,
                    mode=dr.ReduceMode.Permute,
                )
        return loss, target

    def rows_adjoint(self, slopes):
        """Filter the derivatives along rows."""
        tile, row, taps, origins = self._row(slopes, self.height)
        target = dr.empty(mi.Float, 4 * self.padded_width * self.height)
        for k, s in enumerate(_blur([self._carry(origins, k, s) for k, s in zip(TAPS, taps)])):
            dr.scatter(
                target, mi.Vector4f(*s, 0), row * self.padded_width + tile * TILE + k, mode=dr.ReduceMode.Permute
            )
        return target

    def columns_adjoint(self, slopes, factor_l1, factor_ssim):
        """Filter the derivatives along columns. Returns the gradient of the image."""
        lane = dr.arange(mi.Int32, self.down * self.width)
        tile, column = lane // self.width, lane % self.width
        index = tile * (TILE * self.padded_width) + column
        taps = [
            dr.gather(mi.Vector4f, slopes, index + k * self.padded_width, self._inside(tile, k, self.height))
            for k in TAPS
        ]
        origins = [
            self._origin(tile + s, column // TILE, self._inside(tile, s * TILE, self.height)) for s in (-1, 0, 1)
        ]
        ox, oy = origins[1]
        x, y = self._pixels(tile, column, range(TILE))
        target = dr.empty(mi.Float, self.height * self.width)
        for k, (e, g, h) in enumerate(_blur([self._carry(origins, k, s) for k, s in zip(TAPS, taps)])):
            slope = e + g * (y[k] - oy) - h * (x[k] - ox)
            dr.scatter(
                target,
                factor_l1 * _sign(x[k] - y[k]) - factor_ssim * slope,
                (tile * TILE + k) * self.width + column,
                self._inside(tile, k, self.height),
                mode=dr.ReduceMode.Permute,
            )
        return target

    def _pixels(self, tile, column, taps):
        """Both images at taps of the column of a tile, zero outside."""
        index = tile * (TILE * self.width) + column
        active = [self._inside(tile, k, self.height) & (column < self.width) for k in taps]
        return tuple(
            [dr.gather(mi.Float, x, index + k * self.width, a) for k, a in zip(taps, active)]
            for x in (self.image, self.truth)
        )

    def _row(self, packed, stride):
        """A tile's row: its taps, from packets stored by column, and the origins of the tile and its neighbours."""
        lane = dr.arange(mi.Int32, self.across * self.height)
        tile, row = lane // self.height, lane % self.height
        inside = {s: self._inside(tile, s * TILE, self.padded_width) for s in (-1, 0, 1)}
        index = tile * (TILE * stride) + row
        taps = [dr.gather(mi.Vector4f, packed, index + k * stride, inside[k // TILE]) for k in TAPS]
        return tile, row, taps, [self._origin(row // TILE, tile + s, inside[s]) for s in (-1, 0, 1)]

    def _origin(self, down, across, active=True):
        """Both images' values at the middle pixel of a tile (or at the last pixel before it, if the tile is cut off)."""
        row = dr.minimum(down * TILE + TILE // 2, self.height - 1)
        column = dr.minimum(across * TILE + TILE // 2, self.width - 1)
        index = row * self.width + column
        return dr.gather(mi.Float, self.image, index, active), dr.gather(mi.Float, self.truth, index, active)

    @staticmethod
    def _inside(tile, k, size):
        """Return whether tap k of a tile lies in the image, along an axis of `size` pixels."""
        return tile > 0 if k < 0 else tile * TILE + k < size

    @staticmethod
    def _step(origins, k):
        """The origin of tap k's tile relative to the origin of the tile itself."""
        if 0 <= k < TILE:
            return mi.Float(0), mi.Float(0)
        there, here = origins[k // TILE + 1], origins[1]
        return there[0] - here[0], there[1] - here[1]

    def _carry(self, origins, k, s):
        """The linear function of tap k, converted to the tile's own origin."""
        if 0 <= k < TILE:
            return s.x, s.y, s.z
        dx, dy = self._step(origins, k)
        return dr.fma(s.z, dx, dr.fma(-s.y, dy, s.x)), s.y, s.z


def _sign(x):
    return dr.select(x > 0, mi.Float(1), dr.select(x < 0, mi.Float(-1), 0))


def _moments(x, y):
    return x, y, dr.fma(x, x, y * y), x * y


def _central(mx, my, squares, product):
    """Means, variance and covariance from means of (x, y, x^2 + y^2, x y)."""
    return mx, my, squares - dr.fma(mx, mx, my * my), dr.fma(-mx, my, product)


def _blur(taps):
    """Window means of TILE + 2 REACH consecutive tuples: TILE tuples."""
    weights = [mi.Float(float(w)) for w in WINDOW[REACH:]]
    fma = dr.fma
    maps = []
    for values in zip(*taps):  # tracing scalars takes half the time of tracing packets
        means = []
        for i in range(REACH, REACH + TILE):
            mean = values[i] * weights[0]
            for k in range(1, REACH + 1):
                mean = fma(values[i - k] + values[i + k], weights[k], mean)
            means.append(mean)
        maps.append(means)
    return list(zip(*maps))


def _compare(mx, my, ox, oy, variance, covariance):
    """1 - SSIM from means relative to an origin (ox, oy), and SSIM's derivative (e, g, h, 0) with that origin."""
    x, y, dm = mx + ox, my + oy, (my - mx) + (oy - ox)
    b1 = dr.fma(x, x, y * y) + C1
    b2 = variance + C2
    inverse = 1 / (b1 * b2)
    i1, i2 = inverse * b2, inverse * b1
    luminance = dr.fma(2 * x, y, C1) * i1
    structure = dr.fma(2, covariance, C2) * i2
    g = 2 * luminance * i2
    h = g * structure
    # The luminance's derivative, 2 (y - x luminance) / b1, rewritten without its cancellation.
    e = 2 * structure * i1 * i1 * dm * dr.fma(y, x + y, C1) - g * my + h * mx
    return dr.fma(-luminance, structure, 1), mi.Vector4f(e, g, h, 0)


class _GradientError(dr.CustomOp):
    def eval(self, image, truth, height, width):
        difference = image - truth
        dr.eval(difference)
        i = dr.arange(mi.Int32, height * width)
        total, self.slope = mi.Float(0), mi.Float(0)
        for place, size, stride in ((i % width, width, 1), (i // width, height, width)):
            after, before = place + 1 < size, place > 0
            ahead = dr.select(after, dr.gather(mi.Float, difference, i + stride, after) - difference, 0)
            behind = dr.select(before, difference - dr.gather(mi.Float, difference, i - stride, before), 0)
            total += ahead * ahead
            self.slope += behind - ahead
        dr.eval(total, self.slope)
        self.scale = 1 / (height * width)
        self.size = dr.sqrt(dr.sum(total) * self.scale)
        return self.size

    def backward(self):
        factor: Any = self.grad_out() * self.scale * dr.select(self.size > 0, 1 / self.size, 0)
        dr.make_opaque(factor)
        self.set_grad_in('image', self.slope * factor)

    def name(self):
        return 'error of the gradient'


class _TotalVariation(dr.CustomOp):
    def eval(self, volume, shape):
        nz, ny, nx = shape
        i = dr.arange(mi.Int32, nz * ny * nx)
        places = i % nx, i // nx % ny, i // (nx * ny)
        total, self.slope = mi.Float(0), mi.Float(0)
        count = 0
        for place, size, stride in zip(places, (nx, ny, nz), (1, nx, nx * ny)):
            if size > 1:
                count += (size - 1) * (nz * ny * nx // size)
                ahead = dr.gather(mi.Float, volume, i + stride, place + 1 < size)
                behind = dr.gather(mi.Float, volume, i - stride, place > 0)
                after = dr.select(place + 1 < size, ahead - volume, 0)
                before = dr.select(place > 0, volume - behind, 0)
                total += dr.abs(after)
                self.slope += _sign(before) - _sign(after)
        self.scale = 1 / max(count, 1)
        dr.eval(total, self.slope)
        return dr.sum(total) * self.scale

    def backward(self):
        upstream: Any = self.grad_out()
        dr.make_opaque(upstream)
        self.set_grad_in('volume', self.slope * (upstream * self.scale))

    def name(self):
        return 'total variation'
