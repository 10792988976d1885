"""The initial cloud of a fit, by the method of the setting `init`."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from lingo_mi.common.runtime import one_at_a_time
from lingo_mi.fitting.bounded import bounded
from lingo_mi.fitting.cloud_model import CloudModel
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.edge_start import edge_start
from lingo_mi.fitting.measured import density_unit, linearised
from lingo_mi.fitting.r2_start import r2_initialise
from lingo_mi.fitting.settings import Settings
from lingo_mi.fitting.state import start as initial_state
from lingo_mi.fitting.uniform_start import cuboid, random_points
from lingo_mi.lingo import initialise as lingo
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.rectify import can_rectify
from lingo_mi.scan import Scan


@one_at_a_time()
def initial_cloud(scan: Scan, settings: Settings, seed: int = 0) -> InitialCloud:
    """The start of a fit of `scan`: LINGO's cloud (paper, section III-A and B), R2-Gaussian's, points on edges or in
    the volume; of a neural field a cloud of no points.

    `info['seconds']` is the whole time, including reconstructions and renderings. Raises InputError if the scan
    gives no cloud.
    """
    begun = time.perf_counter()
    settings = bounded(settings, scan)
    rng = np.random.default_rng(seed)
    scan = linearised(scan, settings)
    g, unit = scan.geometry, density_unit(scan, settings)
    start = settings.start
    if start.init == 'network':
        cloud = InitialCloud(np.zeros((0, 3)), None, np.zeros(0))
    elif start.init == 'random':
        cloud = random_points(g.half, g.nVoxel[2] == 1, start.n_points, rng)
    elif start.init == 'cuboid':
        cloud = cuboid(g.nVoxel, g.half, start.cuboid_step)
    elif start.init == 'r2':
        volume = FDK().run(scan).volume / unit
        cloud = r2_initialise(volume, g.half, rng, start.n_points, start.fdk_threshold, start.fdk_rescale)
        cloud = cloud.denser(unit)
    else:

        def render(points, density, spacing, views):
            state = DeviceState(initial_state(points, spacing, density / unit, settings))
            return CloudModel(settings, g, unit).render(state, g.subset(views)) * g.scale

        if start.init == 'edges':
            cloud = edge_start(scan, render, start.n_points, rng)
        else:
            if start.init_density == 'fdk' and not can_rectify(scan):
                start = replace(start, init_density='lsq')
            volume = FDK().run(scan).volume if start.init_density == 'fdk' else None
            cloud = lingo.initialise(scan, start, rng, render, volume)
    cloud.info['seconds'] = time.perf_counter() - begun
    return cloud
