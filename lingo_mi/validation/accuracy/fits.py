"""Quality against seconds: initial clouds and fits of the foot phantom."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lingo_mi import phantoms
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import Running, run
from lingo_mi.fitting.measure import quick_measure
from lingo_mi.fitting.methods.by_name import CLOUDS, METHODS
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.ipsd import ipsd
from lingo_mi.phantoms.x3d_scan import project_phantom
from lingo_mi.scan import Dataset, Scan
from lingo_mi.validation.accuracy.images import EXTENT
from lingo_mi.validation.accuracy.sizes import Sizes


def dataset(side: int, pixels: int, views: int) -> Dataset:
    """The foot phantom on side^3 voxels, before panels of pixels^2."""
    phantom = phantoms.make('foot', side)
    angles = np.concatenate([circular(views, 180.0), np.sort(np.random.default_rng(0).uniform(0, np.pi, views))])
    geometry = CircularGeometry(
        DSO=1000.0,
        DSD=1500.0,
        nDetector=(pixels, pixels),
        dDetector=(512 / pixels, 512 / pixels),
        angles=angles,
        grid=Grid(phantom.data.shape, phantom.spacing),
    )
    both = Scan(geometry, project_phantom(phantom, geometry))
    return Dataset(both.subset(slice(0, views)), both.subset(slice(views, None)), phantom.data)


def initialisations(sizes: Sizes) -> list[dict]:
    """Quality of initial clouds, before any iteration, and their IPSD: from the Gaussians that are born in a fit from there."""
    side = sizes.phantoms[0]
    data = dataset(side, side, sizes.views)
    rows = []
    kinds = {
        'edges': dict(start='edges'),
        'lingo': dict(start='masks'),
        'lingo, paper density': dict(start='masks', density='paper'),
        'r2': dict(start='fdk'),
    }
    fast = Fast().changed(values_per_gaussian=0, iterations=sizes.iterations[-2])  # as many points as asked for
    fast.changed(n_points=sizes.points[0]).starting_cloud(data.train)  # compiles
    for name, changes in kinds.items():
        for n in sizes.points:
            method = fast.changed(n_points=n, **changes).bounded(data.train)
            before, state = Running(data.train, data.train, method, 0, None, None).fit(), run(data.train, method).state
            born = state.values['centre'][state.born]
            rows.append(
                dict(
                    name=name,
                    points=len(before),
                    seconds=before.info['seconds'],
                    ipsd=ipsd(before.checkpoint.arrays['initial'], born) if len(born) else None,
                    **_quality(data)(before),
                )
            )
    return rows


def _quality(data: Dataset) -> Callable[[Fit], dict]:
    """Measures a fit by all held-out views and the true volume."""
    return lambda fit: quick_measure(fit.with_data(data))


def curves(sizes: Sizes) -> list[dict]:
    """Quality against seconds: methods, iterations, cut-off, Gaussians, size of the phantom and of the panel."""
    small, middle = sizes.phantoms[0], sizes.iterations[-2]
    plans: list[dict[str, Any]] = [dict(name=name, iterations=n) for name in CLOUDS for n in sizes.iterations]
    plans += [dict(extent=e) for e in (2.0, 4.0, EXTENT)]
    plans += [dict(points=p) for p in sizes.points if p != sizes.points[1]]
    plans += [dict(values_per_gaussian=v) for v in (3.5, 56.0)]
    plans += [dict(pixels=2 * small), dict(pixels=small // 2)]
    for side in sizes.phantoms[1:]:
        plans += [dict(side=side, pixels=p, iterations=sizes.iterations[-1]) for p in (small, side)]
    scans, rows = {}, []
    usual: dict[str, Any] = dict(
        name='fast',
        side=small,
        pixels=small,
        iterations=middle,
        points=sizes.points[1],
        extent=3.0,
        values_per_gaussian=None,
    )  # the method's own
    for changes in plans:
        plan = usual | changes
        side, pixels = plan['side'], plan['pixels']
        if (side, pixels) not in scans:
            scans[side, pixels] = dataset(side, pixels, sizes.views)
        data, method = scans[side, pixels], METHODS[plan['name']]
        method = method.changed(iterations=plan['iterations'], n_points=plan['points'], extent=plan['extent'])
        if plan['values_per_gaussian'] is not None:
            method = method.changed(values_per_gaussian=plan['values_per_gaussian'])
        fit = run(data.train, method, measure=_quality(data))
        rows.append(
            plan
            | dict(
                asked=plan['points'],
                points=len(fit.checkpoint.arrays['initial']),
                gaussians=len(fit),
                seconds=fit.seconds,
                seconds_init=fit.info['seconds'],
                history=fit.history,
                **{k: v for k, v in fit.history[-1].items() if k.startswith('psnr')},
            )
        )
    return rows
