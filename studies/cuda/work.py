"""The work that is counted under a stand-in for the CUDA driver: `python -m studies.cuda.work CLOUD PART`.

CLOUD is the checkpoint of a fit, or `giants`: 300 random Gaussians that fill the image. PART is

    sizes         print a line of JSON: the Gaussians, the image's pixels, and the pairs of a Gaussian and a pixel, inside the
                  cut-off (`pairs`) and inside the footprint's box (`boxes`)
    image         project it into one view of its scan
    derivatives   that, and backpropagate an image of random derivatives
    steps N       N steps of its fit on that view: the gain from N to N + 1 is one step
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.runtime import use_variant
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.fit import Fit, load_fit
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.cutoff import FIT
from lingo_mi.projectors.footprint import project
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import View
from lingo_mi.scan import Scan
from lingo_mi.validation.pairs import count_pairs

VIEW = 3


def giants() -> tuple[Sequence[np.ndarray], Geometry]:
    """Random Gaussians with standard deviations of about 15 mm, and a scan of 512 x 512 pixels of 1 mm."""
    rng, count = np.random.default_rng(0), 300
    cloud = [
        rng.uniform(-60, 60, (count, 3)),
        15 * np.exp(rng.normal(0, 0.4, (count, 3))),
        rng.normal(size=(count, 4)),
        rng.uniform(0.01, 0.02, count),
    ]
    return cloud, Geometry.cone(
        DSO=1000, DSD=1500, nDetector=512, dDetector=1, nVoxel=256, dVoxel=1, angles=circular(50)
    )


def main() -> None:
    name, part, *count = sys.argv[1:]
    use_variant('cuda_ad_mono')
    if part == 'steps':
        return steps(load_fit(name), int(count[0]))
    fit = None if name == 'giants' else load_fit(name)
    cloud, geometry = giants() if fit is None else (fit.gaussians, fit.nominal_geometry)
    *vectors, density = (np.asarray(x, np.float32) for x in cloud)
    types = mi.Point3f, mi.Vector3f, mi.Vector4f
    gaussians = [*(Type(*map(uploaded, x.T)) for Type, x in zip(types, vectors)), uploaded(density)]
    view = View.of(geometry.rays(), VIEW, *geometry.nDetector)
    if part == 'sizes':
        print(json.dumps(sizes(gaussians, view)))
    else:
        image(gaussians, view, derivatives=part == 'derivatives')


def image(gaussians: Sequence, view: View, derivatives: bool) -> None:
    """Project a cloud into one view, and backpropagate."""
    if derivatives:
        dr.enable_grad(gaussians)
    result = line_integrals(*gaussians, view=view, options=RenderOptions(FIT))
    dr.eval(result)
    if derivatives:
        upstream = np.random.default_rng(1).normal(size=dr.width(result)).astype(np.float32)
        dr.set_grad(result, uploaded(upstream))
        dr.enqueue(dr.ADMode.Backward, result)
        dr.traverse(dr.ADMode.Backward)
        dr.eval([dr.grad(x) for x in gaussians])
    dr.sync_thread()


def steps(fit: Fit, count: int) -> None:
    """Late steps of a fit, on one view with random pixels: what is counted does not depend on them."""
    geometry, rng = fit.nominal_geometry.subset([VIEW]), np.random.default_rng(0)
    scan = Scan(geometry, rng.uniform(1, 2, (1, *geometry.nDetector)))
    stepper, state = fit.method.stepper(scan), DeviceState(fit.state)
    for i in range(count):
        stepper.step(state, [0], fit.method.iterations - 1 - count + i, rng)
    dr.sync_thread()


def sizes(gaussians: Sequence, view: View) -> dict:
    """Return the sizes of the work."""
    Float64: Any = dr.float64_array_t(mi.Float)
    area = dr.sum(Float64(project(gaussians, view, FIT).area))
    return dict(
        gaussians=dr.width(gaussians[-1]),
        pixels=view.width * view.height,
        pairs=int(area[0]),
        boxes=int(count_pairs(gaussians, view, FIT)),
    )


if __name__ == '__main__':
    main()
