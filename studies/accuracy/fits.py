"""Quality against seconds: initial clouds and fits of the foot phantom."""

from __future__ import annotations

from typing import Any

import numpy as np

from lingo_mi import phantoms
from lingo_mi.fitting.cloud_model import CloudModel
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.initial import initial_cloud
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.measured import density_unit
from lingo_mi.fitting.recipes import CLOUDS, METHODS
from lingo_mi.fitting.state import start
from lingo_mi.geometry.base import CircularGeometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.ipsd import ipsd
from lingo_mi.phantoms.x3d_scan import simulate
from lingo_mi.results.measure import quick_measure
from lingo_mi.scan import Dataset, Scan
from lingo_mi.studies.accuracy.images import EXTENT
from lingo_mi.studies.accuracy.sizes import Sizes


def dataset(side: int, pixels: int, views: int) -> Dataset:
    """The foot phantom on side^3 voxels, before panels of pixels^2."""
    phantom = phantoms.make('foot', side)
    angles = np.concatenate([circular(views, 180.0), np.sort(np.random.default_rng(0).uniform(0, np.pi, views))])
    geometry = CircularGeometry(
        DSO=1000.0,
        DSD=1500.0,
        nDetector=(pixels, pixels),
        dDetector=(512 / pixels, 512 / pixels),
        nVoxel=phantom.data.shape,
        dVoxel=phantom.spacing,
        angles=angles,
    )
    both = Scan(geometry, simulate(phantom, geometry))
    return Dataset(both.subset(slice(0, views)), both.subset(slice(views, None)), phantom.data)


def initialisations(sizes: Sizes) -> list[dict]:
    """Quality of initial clouds, before any iteration, and their IPSD: from the Gaussians that are born in a fit from there."""
    side = sizes.phantoms[0]
    data = dataset(side, side, sizes.views)
    rows = []
    kinds = {
        'edges': dict(init='edges'),
        'lingo': dict(init='lingo'),
        'lingo, paper density': dict(init='lingo', init_density='paper'),
        'r2': dict(init='r2'),
    }
    fast = METHODS['fast'].changed(
        values_per_gaussian=0, iterations=sizes.iterations[-2]
    )  # as many points as asked for
    initial_cloud(data.train, fast.changed(n_points=sizes.points[0]))  # compiles
    for name, changes in kinds.items():
        for n in sizes.points:
            settings = fast.changed(n_points=n, **changes)
            cloud = initial_cloud(data.train, settings)
            model = CloudModel(settings, data.train.geometry, density_unit(data.train, settings))
            density = None if cloud.density is None else cloud.density / model.unit
            state = DeviceState(start(cloud.points, cloud.spacing, density, settings))
            fitted = run(data.train, settings, cloud)
            born = fitted.state.values['centre'][fitted.state.born]
            rows.append(
                dict(
                    name=name,
                    points=len(cloud),
                    seconds=cloud.info['seconds'],
                    ipsd=ipsd(fitted.initial, born) if len(born) else None,
                    **quick_measure(data)(model, state),
                )
            )
    return rows


def curves(sizes: Sizes) -> list[dict]:
    """Quality against seconds: recipes, iterations, cut-off, Gaussians, size of the phantom and of the panel."""
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
        settings = method.changed(iterations=plan['iterations'], n_points=plan['points'], extent=plan['extent'])
        if plan['values_per_gaussian'] is not None:
            settings = settings.changed(values_per_gaussian=plan['values_per_gaussian'])
        cloud = initial_cloud(data.train, settings)
        fitted = run(data.train, settings, cloud, measure=quick_measure(data))
        rows.append(
            plan
            | dict(
                asked=plan['points'],
                points=len(cloud),
                gaussians=len(fitted.state),
                seconds=fitted.info['seconds'] + fitted.seconds,
                seconds_init=fitted.info['seconds'],
                history=fitted.history,
                **{k: v for k, v in fitted.history[-1].items() if k.startswith('psnr')},
            )
        )
    return rows
