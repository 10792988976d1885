"""A cloud of Gaussians as arrays, with the cut-off that belongs to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from lingo_mi.common.arrays import as_numpy
from lingo_mi.files.r2_cloud import read_r2_cloud, write_r2_cloud
from lingo_mi.geometry.grid import Grid
from lingo_mi.projectors import cutoff

_REAL_FIRST, _REAL_LAST = np.array([3, 0, 1, 2]), np.array([1, 2, 3, 0])  # arrays, as JAX takes no lists


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
        (x, y, z, w), float [N, 4]. A fit's quaternions have unit length.
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

    @classmethod
    def from_r2(cls, path: str | PathLike, grid: Grid) -> Gaussians:
        """Read a cloud of R2-Gaussian, whose quaternions have the real part first: `init_*.npy` or `point_cloud.pickle`.

        Parameters
        ----------
        path : path-like
            The file.
        grid : Grid
            The voxels of its scan. R2-Gaussian makes their longest side 2 long.

        Raises
        ------
        InputError
            If the file is damaged or holds no cloud.

        Examples
        --------
        ::

            cloud = lm.Gaussians.from_r2('point_cloud.pickle', data.train.geometry.grid)
            volume = lm.voxelize(cloud, data.train.geometry.grid)
        """
        return cls(*read_r2_cloud(path, grid), extent=cutoff.FIT)

    def to_r2(self, path: str | PathLike, grid: Grid) -> None:
        """Write the cloud for R2-Gaussian: a .pickle, or an .npy without scales and quaternions, from which a training starts.

        Parameters
        ----------
        path : path-like
            The file; an existing one is replaced.
        grid : Grid
            As for `from_r2`.

        Raises
        ------
        InputError
            For another suffix, for negative densities, and for a file that cannot be written.
        """
        write_r2_cloud(path, grid, *(as_numpy(array, 'the Gaussians', np.float64) for array in self))

    @classmethod
    def from_gsplat(cls, means: Any, quats: Any, scales: Any, density: Any) -> Gaussians:
        """Take arrays in the order of gsplat's `rasterization`, of NumPy, PyTorch or JAX.

        Parameters
        ----------
        means, quats, scales, density
            Centres in mm [N, 3], quaternions (w, x, y, z) [N, 4], standard deviations in mm [N, 3] and densities per mm [N].

        Returns
        -------
        Gaussians
            With quaternions (x, y, z, w).

        Examples
        --------
        >>> import numpy as np
        >>> cloud = Gaussians.from_gsplat(np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)), np.ones(1))
        >>> cloud.quaternions.tolist()
        [[0.0, 0.0, 0.0, 1.0]]
        """
        return cls(means, scales, quats[..., _REAL_LAST], density)

    def to_gsplat(self) -> tuple[Any, Any, Any, Any]:
        """Return the arrays in the order of gsplat's `rasterization`.

        gsplat's fourth argument is an opacity in [0, 1], and a density is not: gsplat renders surfaces, not line integrals.

        Returns
        -------
        tuple
            means [N, 3], quats (w, x, y, z) [N, 4], scales [N, 3], density [N].

        Examples
        --------
        >>> import numpy as np
        >>> cloud = Gaussians(np.zeros((1, 3)), np.ones((1, 3)), np.array([[0.0, 0, 0, 1]]), np.ones(1))
        >>> means, quats, scales, density = cloud.to_gsplat()
        >>> quats.tolist()
        [[1.0, 0.0, 0.0, 0.0]]
        """
        return self.means, self.quaternions[..., _REAL_FIRST], self.scales, self.density
