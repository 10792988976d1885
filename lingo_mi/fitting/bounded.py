"""Settings of a fit, limited by its scan."""

from __future__ import annotations

import math

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import room
from lingo_mi.fitting.measured import knows_noise, trusted
from lingo_mi.fitting.models import parameter_shapes
from lingo_mi.fitting.settings import Settings
from lingo_mi.reconstruction.held_out import LEAST_VIEWS
from lingo_mi.scan import Scan

FIELD_BYTES = 32  # for each parameter of a neural field: its moments, its derivatives and copies of these
BYTES = 500  # that a fit needs at least for each Gaussian: 14 parameters, their moments and derivatives, and copies


def bounded(settings: Settings, scan: Scan) -> Settings:
    """The settings, limited by a scan.

    The largest scale is lowered so that no Gaussian in the volume can reach the source: in a cone beam such a Gaussian has
    no footprint (see `projectors.footprint`). `values_per_gaussian` limits the number of Gaussians, `tv_views` the total
    variation. `stop` is decided. The other settings of a neural field stay as they are.

    Raises InputError if the source is inside the volume, for stop=on where views cannot be held out, for a step of more views
    than the scan has, and for more Gaussians at the start, or a larger field, than this process has memory for.
    """
    g = scan.geometry
    if settings.batch > len(scan):
        raise InputError(
            f'batch is the number of views in a step: at most the {len(scan)} of the scan, not {settings.batch}'
        )
    valid = trusted(scan, settings).valid
    settings = settings.changed(stop='on' if _stops(settings, scan, valid) else 'off')
    if not settings.cloud:
        needed = FIELD_BYTES * sum(n for n, _ in parameter_shapes(settings, 0).values())
        if needed > (has := room()):
            raise InputError(
                f'the field needs at least {needed / 2**30:,.1f} GiB of memory, but this process may take '
                f'{has / 2**30:,.1f} GiB: lower field_entries'
            )
        return settings
    loss, control, bounds = settings.loss, settings.densification, settings.bounds
    if 0 < loss.tv_views < len(scan):
        settings = settings.changed(lambda_tv=loss.lambda_tv * loss.tv_views / len(scan), tv_views=0)
    if control.values_per_gaussian > 0:
        measured = scan.projections.size if valid is None else int(valid.sum())
        most = min(max(int(measured / control.values_per_gaussian), 1), control.max_gaussians)
        settings = settings.changed(max_gaussians=most, n_points=min(settings.start.n_points, most))
    points = settings.start.n_points
    if settings.start.init == 'r2':  # takes no voxel twice
        points = min(points, math.prod(g.nVoxel))
    if settings.start.init != 'cuboid' and points * BYTES > (has := room()):
        raise InputError(
            f'{points} Gaussians need at least {points * BYTES / 2**30:,.1f} GiB of memory, but this process may take '
            f'{has / 2**30:,.1f} GiB: lower n_points'
        )
    if g.mode == 'parallel':
        return settings
    rays = g.normalised_rays()
    clear = np.linalg.norm(rays.source, axis=1).min() - np.linalg.norm(g.half)
    largest = 0.9 * clear / settings.model.extent
    if largest <= bounds.scale_min:
        raise InputError('the source lies within the volume or close to it: check DSO, nVoxel and dVoxel')
    return settings.changed(scale_max=min(bounds.scale_max, largest))


def _stops(settings: Settings, scan: Scan, valid: np.ndarray | None) -> bool:
    """Whether a fit of the scan, of whose pixels those are valid, is to stop early, by views that are held out."""
    free = max(settings.adam.rate_pose) > 0 and settings.calibration.pose_motion == 'view'
    why = None
    views = len(scan) if valid is None else int(valid.any((1, 2)).sum())
    if views < LEAST_VIEWS:
        why = f'needs at least {LEAST_VIEWS} with valid pixels, but the scan has {views}'
    elif free:
        why = 'cannot know their poses: take pose_motion=smooth'
    if settings.stopping.stop == 'on' and why:
        raise InputError(f'stop=on holds views out, and {why}, or leave it out')
    return settings.stopping.stop == 'on' or settings.stopping.stop == 'auto' and not why and knows_noise(scan)
