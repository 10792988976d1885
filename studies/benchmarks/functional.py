"""Overhead of PyTorch: time of `functional.project` and its derivatives, relative to the same in Dr.Jit.

    python -m studies.benchmarks.functional
    python -m studies.benchmarks.functional --gaussians 50000 --pixels 512 --variant cuda_ad_mono

Both project one view of a random cloud and backpropagate an image of random derivatives to the four parameters. They run in
turns; the ratio is taken of the medians over all turns.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.runtime import use_variant
from lingo_mi.functional import project
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import View

WARM = 3  # turns that are not counted


def main() -> None:
    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('--gaussians', type=int, default=20_000)
    p.add_argument('--pixels', type=int, default=256, help='rows and columns of the panel')
    p.add_argument('--repeats', type=int, default=20, help='turns')
    p.add_argument('--variant', help='Mitsuba variant')
    args = p.parse_args()
    variant = use_variant(args.variant)
    native, torch = measured(args.gaussians, args.pixels, args.repeats)
    print(
        f'{variant}, {args.gaussians} Gaussians, {args.pixels} x {args.pixels} pixels: Dr.Jit {1e3 * native:.2f} ms, PyTorch '
        f'{1e3 * torch:.2f} ms, ratio {torch / native:.3f}; medians of {args.repeats} turns'
    )


def measured(count: int, pixels: int, repeats: int) -> tuple[float, float]:
    """Seconds for an image of a cloud and its derivatives, in Dr.Jit alone and through PyTorch: medians of so many turns."""
    rng = np.random.default_rng(0)
    cloud = (
        rng.uniform(-60, 60, (count, 3)),
        2 * np.exp(rng.normal(0, 0.3, (count, 3))),
        rng.normal(size=(count, 4)),
        rng.uniform(0.01, 0.02, count),
    )
    geometry = Geometry.cone(
        DSO=500, DSD=750, nDetector=pixels, dDetector=256 / pixels, nVoxel=64, dVoxel=2.5, angles=circular(1)
    )
    upstream = np.float32(rng.normal(size=(pixels, pixels)))
    both = _native(cloud, geometry, upstream), _through_torch(cloud, geometry, upstream)
    turns = [[_seconds(f) for f in both] for _ in range(WARM + repeats)]
    return tuple(np.median(turns[WARM:], axis=0))


def _native(cloud, geometry, upstream):
    *vectors, density = cloud
    types = mi.Point3f, mi.Vector3f, mi.Vector4f
    gaussians = [*(Type(*map(uploaded, x.T)) for Type, x in zip(types, vectors)), uploaded(density)]
    view, upstream = View.of(geometry.rays(), 0, *geometry.nDetector), uploaded(upstream.ravel())

    def run():
        leaf = [dr.detach(x) for x in gaussians]
        dr.enable_grad(leaf)
        image = line_integrals(*leaf, view=view, options=RenderOptions())
        dr.set_grad(image, upstream)
        dr.enqueue(dr.ADMode.Backward, image)
        dr.traverse(dr.ADMode.Backward)
        dr.eval([dr.grad(x) for x in leaf])
        dr.sync_thread()

    return run


def _through_torch(cloud, geometry, upstream):
    import torch  # an extra, and heavy

    device = 'cuda' if dr.backend_v(mi.Float) == dr.JitBackend.CUDA else 'cpu'
    tensors = [torch.tensor(x, dtype=torch.float32, device=device, requires_grad=True) for x in cloud]
    upstream = torch.tensor(upstream[None], device=device)

    def run():
        for x in tensors:
            x.grad = None
        image: Any = project(*tensors, geometry=geometry)
        image.backward(upstream)
        dr.sync_thread()
        if device == 'cuda':
            torch.cuda.synchronize()

    return run


def _seconds(function) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


if __name__ == '__main__':
    main()
