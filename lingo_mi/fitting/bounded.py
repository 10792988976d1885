"""The settings of a fit with the bounds that its scan sets."""

from __future__ import annotations

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.fitting.models import forward_model
from lingo_mi.fitting.settings import Settings
from lingo_mi.scan import Scan


def bounded(settings: Settings, scan: Scan) -> Settings:
    """The settings with the bounds that a scan sets.

    The largest scale becomes so small that no Gaussian in the volume can reach the source: beyond it the integral of a
    cone beam's Gaussian is no footprint (see `projectors.footprint`). `values_per_gaussian` bounds the number of Gaussians.
    What is in units of the scene's radius becomes a length. Raises InputError where the source is in the volume.
    """
    g = scan.geometry
    settings = forward_model(settings).with_lengths(g)
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
