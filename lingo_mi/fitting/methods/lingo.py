"""LINGO."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lingo_mi.fitting.methods.densities import DensityMethod
from lingo_mi.fitting.options.loss import Loss
from lingo_mi.fitting.start.masks import MaskStart
from lingo_mi.fitting.start.start import Start


@dataclass(frozen=True)
class LINGO(DensityMethod):
    """LINGO, the published method: Otsu masks of all views for a start, and R2-Gaussian's fit with a dynamic loss scale.

    It has the options of `DensityMethod`. The paper takes the mean pixel as the density of a Gaussian (`density='paper'`). The
    default `density='lsq'` of `MaskStart` also multiplies it by a fitted factor.

    References
    ----------
    Xing, Jin, Bu, He and Ying, "LINGO: Latent Initialization and Gradient Optimization for Sparse-view X-ray Novel View Synthesis
    and CT Reconstruction with 3D Gaussian Splatting".

    Examples
    --------
    >>> LINGO().changed(V_S=1).start.V_S
    1
    """

    name: ClassVar = 'lingo'

    start: Start = MaskStart()
    loss: Loss = Loss(loss_scale='dynamic')
