"""R2-Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lingo_mi.fitting.methods.densities import DensityMethod


@dataclass(frozen=True)
class R2(DensityMethod):
    """R2-Gaussian with its published settings: voxels of an FDK volume for a start, 30,000 steps.

    It has the options of `DensityMethod`.

    References
    ----------
    Zha, Lin, Cai, Cao, Zhang and Li, "R2-Gaussian: Rectifying Radiative Gaussian Splatting for Tomographic Reconstruction",
    NeurIPS 2024.

    Examples
    --------
    >>> R2().changed(iterations=5000).densify.densify_until
    15000
    """

    name: ClassVar = 'r2'
