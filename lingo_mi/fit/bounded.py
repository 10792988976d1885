"""The settings of a fit with the bounds that its scan sets."""

from __future__ import annotations

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.fit.settings import Settings
from lingo_mi.geometry.base import Geometry
from lingo_mi.scan import Scan


def bounded(settings: Settings, scan: Scan) -> Settings:
    """The settings with the bounds that a scan sets.

    The largest scale becomes so small that no Gaussian in the volume can reach the source: beyond it the integral of a
    cone beam's Gaussian is no footprint (see `projectors.footprint`). `values_per_gaussian` bounds the number of Gaussians.
    What is in units of the scene's radius becomes a length. Raises InputError where the source is in the volume.
    """
    g = scan.geometry
    if not settings.volumetric:
        radius = scene_radius(g)
        settings = settings.changed(
            rate_centre=tuple(radius * r for r in settings.adam.rate_centre),
            split_size=radius * settings.densification.split_size,
            prune_size=radius * settings.densification.prune_size,
        )
    control, bounds = settings.densification, settings.bounds
    if control.values_per_gaussian > 0:
        most = min(max(int(scan.projections.size / control.values_per_gaussian), 1), control.max_gaussians)
        settings = settings.changed(max_gaussians=most, n_points=min(settings.start.n_points, most))
    if g.mode == 'parallel':
        return settings
    rays = g.normalised_rays()
    room = np.linalg.norm(rays.source, axis=1).min() - np.linalg.norm(g.half)
    largest = 0.9 * room / settings.model.extent
    if largest <= bounds.scale_min:
        raise InputError('the source lies within the volume or close to it: check DSO, nVoxel and dVoxel')
    return settings.changed(scale_max=min(bounds.scale_max, largest))


def scene_radius(geometry: Geometry) -> float:
    """3DGS's unit of length: 1.1 times the largest distance of a source from the mean of all, in the normalised frame.

    1 where there is no such distance: for a single view, and for a parallel beam, which has no source.
    """
    rays = geometry.normalised_rays()
    if rays.parallel:
        return 1.0
    return 1.1 * float(np.linalg.norm(rays.source - rays.source.mean(0), axis=1).max()) or 1.0
