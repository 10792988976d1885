"""A cloud of Gaussians as arrays, with the cut-off that belongs to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from lingo_mi.projectors import cutoff


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A cloud of N Gaussians in the world frame of a scan, for `lm.project` and `lm.voxelize`.

    It unpacks into four arrays without the cut-off: `means, scales, quaternions, density = cloud`.

    Attributes
    ----------
    means : array
        Centres, mm, float [N, 3].
    scales : array
        Standard deviations, mm, float [N, 3].
    quaternions : array
        (x, y, z, w), float [N, 4]. Those of a fit have unit length.
    density : array
        Values at the centres, 1/mm, float [N]; opacities for `GaussianSplatting` and `XGaussian`.
    extent : float
        Cut-off in standard deviations. Use the Gaussians of a fit with the cut-off of this fit, because the fit depends on it.

    Examples
    --------
    ::

        images = lm.project(fit.gaussians, geometry)      # the same as fit.render(geometry)
    """

    means: Any
    scales: Any
    quaternions: Any
    density: Any
    extent: float = cutoff.RENDER

    def __iter__(self) -> Iterator[Any]:
        return iter((self.means, self.scales, self.quaternions, self.density))

    def __len__(self) -> int:
        """N."""
        return len(self.density)
