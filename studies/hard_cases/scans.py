"""Fits to bad data: empty, saturated, noisy or repeated views, and Gaussians all at one place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.fitting.start.start import Render, Start, StartingCloud
from lingo_mi.fitting.state import activate
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.scan import Scan
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Pose, random_cloud
from studies.hard_cases.kinds import ScanCase


def measured(angles: ArrayLike, shape: tuple[int, int] = (24, 24)) -> Scan:
    """An exact scan of some Gaussians, from angles in radians."""
    geometry = Geometry.cone(
        DSO=5.0, DSD=7.5, nDetector=shape, dDetector=3.4 / max(shape), nVoxel=16, dVoxel=0.125, angles=angles
    )
    cloud, rays = random_cloud(np.random.default_rng(9), 6, spread=0.4, size=0.15), geometry.rays()
    images = [oracle.line_integrals(cloud, Pose.of(rays, i, *shape)) for i in range(len(geometry))]
    return Scan(geometry, np.reshape(images, (-1, *shape)))


@dataclass(frozen=True)
class Coincident(Start):
    """50 Gaussians, some of them in pairs and a tenth all at one place."""

    name: ClassVar = 'coincident'

    def cloud(self, scan: Scan, rng: np.random.Generator, render: Render, unit: float) -> StartingCloud:
        n, rng = 50, np.random.default_rng(10)
        centre = rng.uniform(-0.6, 0.6, (n, 3))
        centre[n // 2 : n // 2 + n // 5] = centre[: n // 5]
        centre[-(n // 10) :] = 0
        return StartingCloud(centre, np.full(n, 0.2), np.full(n, 0.1))


def fit_to(scan: Scan, iterations: int, **changes: Any) -> Fit:
    """A fit that densifies often.

    Parameters
    ----------
    changes
        Changes of its options.

    Raises
    ------
    FloatingPointError
        Unless it ends finite and within its bounds.
    """
    method = replace(Fast(), start=Coincident()).changed(
        **{
            **dict(
                iterations=iterations,
                densify_from=20,
                densify_until=iterations,
                densify_every=25,
                densify_threshold=1e-3,
                max_gaussians=200,
                tv_size=8,
                loss_scale='dynamic',
            ),
            **changes,
        }
    )
    done = run(scan, method, seed=1)
    assert isinstance(done.method, Fast)
    centre, scale, rotation, density = activate(done.state, done.method.forward)
    moments = (x for moment in (done.state.first, done.state.second) for x in moment.values())
    finite = dict(
        Gaussians=(centre, scale, rotation, density), moments=moments, losses=[h['loss'] for h in done.history]
    )
    for name, values in finite.items():
        if not all(np.isfinite(x).all() for x in values):
            raise FloatingPointError(f'the fit ends with {name} that are not finite')
    if not len(density):
        raise FloatingPointError('the fit ends without Gaussians')
    # The sigmoid reaches its bounds where float32 saturates.
    if scale.min() < done.method.bounds.scale_min or scale.max() > done.method.bounds.scale_max:
        raise FloatingPointError(f'the fit ends with scales from {scale.min():g} to {scale.max():g}, out of bounds')
    return done


def adversarial() -> Scan:
    """Eight views: two of them empty, one saturated, one with negative noise, one there twice."""
    angles = circular(8)
    angles[4] = angles[2]
    scan = measured(angles)
    p = scan.projections.copy()
    p[[1, 6]] = 0
    p[3] = p.max() * 30
    p[5] += np.random.default_rng(11).normal(size=p[5].shape) * p.max()
    return Scan(scan.geometry, p)


def of_scans(steps: int) -> Iterator[ScanCase]:
    """All of them. steps   of the fit to adversarial data"""

    def changed(change):
        scan = measured(circular(3))
        return Scan(scan.geometry, np.broadcast_to(change(scan.projections), scan.projections.shape))

    def holed(p):
        return np.where(np.arange(p.shape[2]) == 4, np.nan, p)

    yield ScanCase('projections with NaN', lambda: changed(holed), refused='NaN or infinity')
    yield ScanCase('projections all zero', lambda: fit_to(changed(np.zeros_like), 5), refused='zero everywhere')
    finite = 'fit ends finite'
    yield ScanCase('projections constant', lambda: fit_to(changed(lambda p: 0.3), 40), note=finite)
    yield ScanCase('projections with negative values', lambda: fit_to(changed(lambda p: p - 0.1), 40), note=finite)
    yield ScanCase('1 view', lambda: fit_to(measured(circular(1)), 20), note=finite)
    yield ScanCase('2 views', lambda: fit_to(measured(circular(2)), 20), note=finite)
    yield ScanCase('1000 views', lambda: fit_to(measured(circular(1000), (8, 8)), 20), note=finite)
    yield ScanCase('views 1e-6 rad apart', lambda: fit_to(measured(np.arange(3) * 1e-6), 40), note=finite)
    yield ScanCase(
        'views empty, saturated, noisy, repeated; Gaussians coincident',
        lambda: fit_to(adversarial(), steps),
        note=f'fit of {steps} steps ends finite',
    )
