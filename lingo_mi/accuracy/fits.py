"""Quality against seconds: initial clouds and fits of the foot phantom."""
from __future__ import annotations

import numpy as np

from .. import phantoms
from ..fit.device import DeviceState
from ..fit.initial import initial_cloud
from ..fit.loop import run
from ..fit.settings import METHODS, VOLUMETRIC
from ..fit.state import start
from ..fit.step import Stepper
from ..geometry import Geometry, circular
from ..phantoms.scanning import simulate
from ..results import quick_measure
from ..scan import Dataset, Scan
from .images import EXTENT
from .sizes import Sizes


def dataset(side: int, views: int) -> Dataset:
    """The foot phantom on side^3 voxels, before panels of side^2 pixels."""
    phantom = phantoms.make('foot', side)
    angles = np.concatenate([circular(views, 180.), np.sort(np.random.default_rng(0).uniform(0, np.pi, views))])
    geometry = Geometry(1000., 1500., side, 512 / side, phantom.data.shape, phantom.spacing, angles)
    both = Scan(geometry, simulate(phantom, geometry))
    return Dataset(both.subset(slice(0, views)), both.subset(slice(views, None)), phantom.data)


def initialisations(sizes: Sizes) -> list[dict]:
    """Quality of initial clouds, before any iteration."""
    data = dataset(sizes.phantoms[0], sizes.views)
    rows = []
    kinds = {'lingo': dict(init='lingo'), 'lingo, paper density': dict(init='lingo', init_density='paper'),
             'r2': dict(init='r2')}
    initial_cloud(data.train, METHODS['fast'].changed(n_points=sizes.points[0]))  # compiles
    for name, changes in kinds.items():
        for n in sizes.points:
            settings = METHODS['fast'].changed(n_points=n, **changes)
            cloud = initial_cloud(data.train, settings)
            stepper = Stepper(data.train, settings)
            state = DeviceState(start(cloud.points, cloud.spacing, cloud.density / stepper.unit, settings))
            rows.append(dict(name=name, points=len(cloud), seconds=cloud.info['seconds'],
                             **quick_measure(data)(stepper, state)))
    return rows


def curves(sizes: Sizes) -> list[dict]:
    """Quality against seconds: recipes, iterations, cut-off, Gaussians to start with, size of the phantom."""
    small, most, points = sizes.phantoms[0], sizes.iterations[-1], sizes.points[1]
    plans = [(name, small, n, points, 3.) for name in VOLUMETRIC for n in sizes.iterations]
    plans += [('fast', small, sizes.iterations[-2], points, e) for e in (2., 4., EXTENT)]
    plans += [('fast', small, sizes.iterations[-2], p, 3.) for p in sizes.points if p != points]
    plans += [('fast', side, most, points, 3.) for side in sizes.phantoms[1:]]
    scans, rows = {}, []
    for name, side, iterations, points, extent in plans:
        data = scans.setdefault(side, dataset(side, sizes.views))
        settings = METHODS[name].changed(iterations=iterations, n_points=points, extent=extent)
        fitted = run(data.train, settings, initial_cloud(data.train, settings), measure=quick_measure(data))
        rows.append(dict(name=name, side=side, iterations=iterations, points=points, extent=extent,
                         gaussians=len(fitted.state), seconds=fitted.info['seconds'] + fitted.seconds,
                         seconds_init=fitted.info['seconds'], history=fitted.history,
                         **{k: v for k, v in fitted.history[-1].items() if k.startswith('psnr')}))
    return rows
