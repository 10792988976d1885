"""One view as Dr.Jit values, for the projector kernels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.rays import Rays
from lingo_mi.projectors.bent import Bend


def vector64(xyz: Iterable[float]) -> Any:
    """An opaque Array3f64 of three Python numbers; literals would be compiled into the kernel."""
    Array3d, Float64 = mi.Vector3d, dr.value_t(mi.Vector3d)
    return Array3d(*(dr.opaque(Float64, float(x)) for x in xyz))


@dataclass
class View:
    """Rays of one view. The ray through the pixel position (x, y), pixel centres at (i + 1/2), runs

    - `cone`: from `source` along D = corner + x u + y v - source
    - `parallel`: through corner + x u + y v along the unit vector `source`

    With a `bend`, (x, y) is the position on the flat panel that the curved one touches.

    Integrals of a cone beam begin at the source. They do not end at the panel, which may be a virtual one within the object.

    Parameters
    ----------
    source, corner, u, v
        Vector3d; differentiable, so gradients reach the pose.
    width, height : int
        Pixels.
    parallel : bool
        Whether the beam is parallel.
    bend : Bend or None
        Bend of a curved panel. It is constant: a pose is differentiable as a rigid motion of source and panel together.
    """

    source: Any
    corner: Any
    u: Any
    v: Any
    width: int
    height: int
    parallel: bool = False
    bend: Bend | None = None

    @staticmethod
    def of(rays: Rays, index: int, height: int, width: int) -> View:
        """View `index` of `lingo_mi.geometry.rays.Rays`."""
        return View(
            *(vector64(a[index]) for a in (rays.source, rays.corner, rays.u, rays.v)),
            width=width,
            height=height,
            parallel=rays.parallel,
            bend=None if rays.curve is None else Bend.of(rays.curve[[index]], width),
        )

    def require_flat(self, what: str) -> None:
        """Raises InputError, which names what needs a flat panel, if this one is curved."""
        if self.bend is not None:
            raise InputError(f'{what} needs a flat panel, and this one is curved: leave out radius')

    def lengths(self) -> Any:
        """|D| of every pixel, Float [height * width], row by row: the Jacobian of the ray parameter, 1 for parallel beams."""
        if self.parallel:
            return mi.Float(1)
        i: Any = dr.arange(mi.UInt32, self.width * self.height)
        x: Any = mi.Float(i % self.width + 0.5)
        y: Any = mi.Float(i // self.width + 0.5)
        if self.bend is not None:
            x, y = (mi.Float(p) for p in self.bend.on_plane(i % self.width, i // self.width))
        axis = self.corner - self.source
        # All in float32, also the constant, which would promote the sum to float64: |D| only needs relative accuracy.
        d = mi.Vector3f(axis) + x * mi.Vector3f(self.u) + y * mi.Vector3f(self.v)
        return dr.norm(d)
