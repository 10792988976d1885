"""Settings of a fit, limited by its scan."""

from __future__ import annotations

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.fitting.models import forward_model
from lingo_mi.fitting.settings import Settings
from lingo_mi.scan import Scan


def bounded(settings: Settings, scan: Scan) -> Settings:
    """The settings, limited by a scan.

    The largest scale is lowered so that no Gaussian in the volume can reach the source: in a cone beam such a Gaussian has
    no footprint (see `projectors.footprint`). `values_per_gaussian` limits the number of Gaussians. Settings in units of the
    scene's radius are converted to lengths. Raises InputError if the source is inside the volume.
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
