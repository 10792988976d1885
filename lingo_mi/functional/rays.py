"""The rays of some views as one array of the caller's, in which images are differentiable."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.errors import InputError
from lingo_mi.functional.frameworks import Argument
from lingo_mi.geometry import CurvedGeometry, Geometry, Rays
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.view import View


def rays_argument(rays: Any, views: int) -> Argument:
    """`rays` as a function of arrays takes them: see `Rays.vectors`."""
    if isinstance(rays, Rays | Geometry):
        raise InputError('rays must be an array [view, 4, 3]: give geometry.rays().vectors')
    return Argument('rays', rays, (views, 4, 3), double=True)


def on_host(vectors: Any, geometry: Geometry) -> Rays:
    """The rays of a tensor [n, 4, 3]. Raises InputError, naming the first bad view: see `Rays.checked`. Waits for the device.

    Also for curved panels, whose rays are not such vectors.
    """
    if isinstance(geometry, CurvedGeometry):
        raise InputError(
            'rays describe flat panels, and the panel of this scan is curved: resample the scan with scan.to_flat()'
        )
    return Rays.from_vectors(dr.detach(vectors).numpy(), geometry.mode == 'parallel')


def beams_of(vectors: Any, geometry: Geometry) -> Iterator[View]:
    """A `View` for each view of a tensor [n, 4, 3], in whose entries it is differentiable. The views are sound: see `on_host`."""
    (height, width), parallel = geometry.nDetector, geometry.mode == 'parallel'
    flat = mi.Float64(vectors.array)
    dr.make_opaque(flat)
    for view in range(vectors.shape[0]):
        first = dr.opaque(mi.UInt32, 12 * view)
        # Every entry is read once, so the derivative needs no atomics.
        parts = [dr.gather(mi.Float64, flat, first + i, mode=dr.ReduceMode.Permute) for i in range(12)]
        source, *others = (mi.Vector3d(*parts[i : i + 3]) for i in range(0, 12, 3))
        if parallel:
            with full_float64():
                source = dr.normalize(source)
        dr.eval(source, others)
        yield View(source, *others, width=width, height=height, parallel=parallel)
