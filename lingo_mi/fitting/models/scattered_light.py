"""The light that a cloud scatters into the views of a scan."""

from __future__ import annotations

import numpy as np

from lingo_mi.effects.hardening import Tube
from lingo_mi.effects.scatter import Scatter, smoothed
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.objects import Ellipsoids
from lingo_mi.projectors.view import View


class ScatteredLight:
    """Light that a cloud in the volume of a scan scatters (`effects.scatter`).

    A view always has the same random numbers, so estimates differ only if the cloud does.

    Parameters
    ----------
    scatter : Scatter
        Parameters; nothing scatters outside the volume, so that a single large Gaussian does not enlarge the box.
    """

    def __init__(self, scatter: Scatter, tube: Tube, response: str, geometry: Geometry):
        self.scatter = scatter.within(geometry)
        self.tube = tube.of_cloud()
        self.response = response

    def estimate(self, cloud: Ellipsoids, geometry: Geometry) -> np.ndarray:
        """Mean scattered light and its standard error on the coarse grid of every view, float64 [2, n, rows, columns].

        Parameters
        ----------
        cloud, geometry
            In mm.
        """
        rays = geometry.rays()
        return np.stack(
            [
                self.scatter.estimate([cloud], self.tube, self.response, View.of(rays, i, *geometry.nDetector), i)
                for i in range(len(geometry))
            ],
            1,
        )


def light_at_pixels(light: np.ndarray, geometry: Geometry) -> np.ndarray:
    """The scattered signal relative to the open beam's at all pixels, float32 [view, v, u]. light: from `estimate`."""
    rows, columns = geometry.nDetector
    views = [smoothed(means, errors, rows, columns) for means, errors in light.swapaxes(0, 1)]
    return np.stack(views).astype(np.float32)
