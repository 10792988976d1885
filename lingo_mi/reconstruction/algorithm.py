"""The interface of all algorithms, and their result."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common import notebook
from lingo_mi.common.arrays import as_numpy, short_repr
from lingo_mi.effects.forward import Effects
from lingo_mi.files.slabs import NIFTI, THICKNESS, write_slabs
from lingo_mi.files.units import unit_of
from lingo_mi.files.volumes import write_volume
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.metrics.quality import compared
from lingo_mi.scan import Scan
from lingo_mi.storage.file_access import as_path, new_file, writing

# Called after every step as progress(steps done, all steps, |A x - b| / |b|). The last is None if an algorithm does not know it.
Progress = Callable[[int, int, float | None], None]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A reconstructed volume with its convergence. `numpy.asarray` of it is the volume.

    Parameters
    ----------
    volume : float32 [x, y, z]
        Density per mm.
    residuals : list[float]
        |A x - b| / |b| at the start and after every iteration (b = 0: |A x|), NaN if it was not computed; none for FDK.
    seconds : float
        Wall-clock time.
    grid : Grid
        Grid of the volume.

    Examples
    --------
    >>> found = lm.reconstruct(scan, lm.SART(niter=20))
    >>> found.metrics(truth)['psnr_3d']
    >>> found.save('out/foot.nii.gz')
    """

    volume: np.ndarray
    residuals: list[float]
    seconds: float
    grid: Grid

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        """For a notebook: slices, each with a slider."""
        return notebook.box(
            f'Reconstruction, {self.seconds:.1f} s', notebook.slices(self.volume, self.grid.spacing, self.grid.centre)
        )

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.array(self.volume, dtype) if copy else np.asarray(self.volume, dtype)

    def metrics(self, truth: ArrayLike) -> dict[str, float | None]:
        """PSNR in dB and SSIM of the volume.

        Parameters
        ----------
        truth : array_like
            The true densities per mm, [x, y, z], on the same voxels.

        Returns
        -------
        dict[str, float or None]
            `psnr_3d` and `ssim_3d`, whose full scale is the largest true density, and R2-Gaussian's `psnr_3d_r2` and
            `ssim_3d_r2`, with the full scale 1; None if a value is not finite.

        Raises
        ------
        InputError
            For a truth of another shape, or that is not finite.

        Examples
        --------
        `lm.reconstruct(scan, lm.FDK()).metrics(data.volume)['psnr_3d']`
        """
        return compared(self.volume, as_numpy(truth, 'the true volume'))

    def save(
        self, path: str | PathLike, *, units: str = '1/mm', mu_water: float | None = None, force: bool = False
    ) -> Path:
        """Write the volume with voxel size and position in mm.

        Parameters
        ----------
        path : path-like
            .nii, .nii.gz, a new .ome.zarr, or a new folder .dicom for a DICOM series (in 'hu'); its folder is made.
        units : str
            Unit of the values in the file: '1/mm', '1/cm' or 'hu', Hounsfield units.
        mu_water : float or None
            Attenuation of water, 1/mm, for 'hu'.
        force : bool
            Replace an earlier file.

        Returns
        -------
        Path
            The path of the file.

        Raises
        ------
        InputError
            For another suffix or unit, a file that is there already, or one that cannot be written.

        Examples
        --------
        >>> result.save('foot.dicom', units='hu', mu_water=0.0206)
        """
        path, unit = as_path('path', path), unit_of(units, mu_water)
        with writing(path):
            new_file(path, force)
            if path.name.endswith(NIFTI):
                write_volume(path, unit.values(self.volume), self.grid, unit.description)
            else:
                write_slabs(path, self.grid, (self.volume[:, :, a:b] for a, b in self.grid.slabs(THICKNESS)), unit)
        return path


class Algorithm(ABC):
    """A reconstruction method: a frozen dataclass with its options as fields, for `lm.reconstruct`.

    One object serves any number of scans. Options are checked when the object is created.

    `lm.reconstruct` is the public way to run an algorithm; code below it calls `run.run_algorithm`, which checks memory and
    signal, and only modules of this package call `_run`.

    Attributes
    ----------
    name
        On the command line and in `ALGORITHMS`.
    no_start
        Why it takes no volume to start from; empty if it takes one.
    """

    name: ClassVar[str]
    no_start: ClassVar[str] = ''

    @abstractmethod
    def _run(self, scan: Scan, *, start: ArrayLike | None = None, progress: Progress | None = None) -> Reconstruction:
        """Reconstruct the volume of a scan, without the checks of `run_algorithm`, which describes the arguments."""

    def seeing(self, effects: Effects | None) -> Algorithm:
        """The algorithm for line integrals of a scan that had these effects. It may use what they tell about the noise."""
        return self

    @property
    def options(self) -> dict[str, Any]:
        """The options by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type] - every algorithm is a dataclass

    def steps(self, scan: Scan) -> int:
        """The largest number of steps, for `progress`."""
        return self.options['niter']

    @property
    def volumes(self) -> float:
        """Peak memory besides the algorithm's `memory_needs.NEEDS`, in volumes on `grid`."""
        return 0.0

    def grid(self, geometry: Geometry) -> Grid:
        """The voxels that the algorithm works on. The result has the geometry's own voxels."""
        return geometry.grid
