"""One line about what the parts of LINGO did in a fit."""

from __future__ import annotations

from math import prod

import numpy as np

from lingo_mi.fitting.fitted_model import FittedModel
from lingo_mi.fitting.options.loss import Loss
from lingo_mi.geometry.trajectories import spread
from lingo_mi.lingo.loss_scale import FLOOR
from lingo_mi.lingo.otsu import otsu

VIEWS = 25  # evenly spaced views that the range of the loss scale is taken from


def lingo_summary(fit: FittedModel) -> str | None:
    """The masks, the voxels that they left, the voxel scaling and the range of the loss scale; None for a fit without these.

    Thresholds are line integrals, as the projections are.
    """
    parts = [*_start(fit), *_loss(fit)]
    return '; '.join(parts) if parts else None


def _start(fit: FittedModel) -> list[str]:
    info, scale = fit.info, fit.nominal_geometry.grid.scale
    if 'T_low' not in info:
        return []
    if not info.get('masks_used', True):
        return [f'masks not used, since they would cut off {info["edges_lost"]:.0%} of the edges']
    low, cells = info['cells_low'], prod(info['grid'])
    scaling = f', voxel scaling S = {info["S"]:.3g}' if 'S' in info else ''
    return [
        f'masks at {info["T_high"] / scale:.3g} and {info["T_low"] / scale:.3g} keep {low:,} of {cells:,} voxels{scaling}'
    ]


def _loss(fit: FittedModel) -> list[str]:
    loss = getattr(fit.method, 'loss', None)
    if not isinstance(loss, Loss) or loss.loss_scale == 'none':
        return []
    geometry = fit.geometry
    images = fit.render(geometry.subset(spread(len(geometry), min(len(geometry), VIEWS)))) * (
        geometry.grid.scale / fit.model.unit
    )
    thresholds = np.maximum([otsu(image) for image in images], FLOOR)
    factors = thresholds + 0.25 / thresholds
    on = ' on the densification alone' if loss.loss_scale == 'statistic' else ''
    return [f'loss scale {factors.min():.3g} to {factors.max():.3g}{on}']
