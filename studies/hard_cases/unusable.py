"""Unusable Gaussians, which a scene must refuse by name."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import mitsuba as mi
import numpy as np

from lingo_mi.validation.oracle import Cloud
from studies.hard_cases.kinds import ScanCase


def unusable() -> Iterator[ScanCase]:
    """All of them, and a needle that is just usable."""
    usable = dict(centre=[[0, 0, 0]], scale=[[0.1, 0.1, 0.1]], rotation=[[0, 0, 0, 1]], density=[1.0])
    for name, changes in {
        'zero quaternion': dict(rotation=[[0, 0, 0, 0]]),
        'NaN in a quaternion': dict(rotation=[[np.nan, 0, 0, 1]]),
        'NaN in a centre': dict(centre=[[0, np.nan, 0]]),
        'zero scale': dict(scale=[[0.1, 0, 0.1]]),
        'negative scale': dict(scale=[[0.1, -0.1, 0.1]]),
        'infinite scale': dict(scale=[[np.inf, 0.1, 0.1]]),
        'NaN density': dict(density=[np.nan]),
        'density 1e30': dict(density=[1e30]),
        'scale 1e-20': dict(scale=[[1e-20] * 3]),
        'centre at 1e20': dict(centre=[[1e20, 0, 0]]),
        'needle 1:1e8': dict(scale=[[1, 1e-8, 1e-8]]),
    }.items():
        yield ScanCase(name, partial(_render, Cloud(**{**usable, **changes})), refused='Gaussian 0 of the ellipsoids')
    needle = Cloud(**{**usable, 'scale': [[1, 2e-7, 2e-7]]})
    yield ScanCase('needle 1:5e6', partial(_render, needle), warned=True)


def _render(cloud):
    data = np.concatenate([cloud.centre, cloud.scale, cloud.rotation], 1)
    scene = mi.load_dict(
        dict(
            type='scene',
            integrator=dict(type='lingo_xray'),
            cloud=dict(
                type='ellipsoids',
                data=mi.TensorXf(data.astype(np.float32)),
                density=mi.TensorXf(cloud.density.astype(np.float32)[:, None]),
            ),
            scanner=dict(
                type='ct_scanner', DSO=5.0, DSD=7.5, nDetector='8', dDetector='.4', nVoxel='8', dVoxel='.25', views=1
            ),
        )
    )
    scene.integrator().render(scene, scene.sensors()[0])
