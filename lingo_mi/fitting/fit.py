"""A fit, running or finished: measured, saved, shown, and loaded again."""

from __future__ import annotations

import base64
import html
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common import notebook
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import whole_number
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.effects.forward import Effects, find_effects
from lingo_mi.files.slabs import THICKNESS, require_whole_chunks, write_slabs
from lingo_mi.files.units import PER_MM, Unit, unit_of
from lingo_mi.fitting import average
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.fitted_model import FittedModel
from lingo_mi.fitting.measure import comparable, fit_metrics
from lingo_mi.fitting.save import description, result_names, write_fit
from lingo_mi.fitting.slab_cluster import voxelize_on
from lingo_mi.geometry.grid import Grid
from lingo_mi.jobs.cluster import workers
from lingo_mi.report.data import ReportData
from lingo_mi.report.figures import overview
from lingo_mi.report.numbers import headline
from lingo_mi.report.page import report_page
from lingo_mi.report.view import Page
from lingo_mi.scan import Dataset
from lingo_mi.scene.load import load_scene
from lingo_mi.storage.file_access import as_path, new_file, writing
from lingo_mi.storage.folder_lock import locked
from lingo_mi.storage.output_folder import (
    CHECKPOINT,
    CLOUD,
    SCENE,
    clear_leftovers,
    occupants,
    require_ours,
    require_together,
)


class Fit(FittedModel):
    """The result of `lm.fit` or `lm.load_fit`. In a notebook it shows slices, views, curves and numbers.

    Examples
    --------
    ::

        fit = lm.fit(data, lm.LINGO())
        fit.volume()                     # float32 [x, y, z], density per mm
        fit.render(data.test.geometry)   # float32 [view, v, u], line integrals
        fit.metrics()['psnr_3d']
        fit.save('out/foot')
    """

    @classmethod
    def load(cls, path: str | PathLike) -> Fit:
        """Load a fit from a folder or from a checkpoint.

        Parameters
        ----------
        path : path-like
            A folder that `lm.fit` or `save` wrote, its result.xml, or a checkpoint (.npz) alone.

        Returns
        -------
        Fit
            Without the scan's data; see `with_data`.

        Raises
        ------
        InputError
            If there is no result, if it is damaged, or if files do not belong together.

        Examples
        --------
        `fit = lm.load_fit('out/foot')`
        """
        ensure_variant()
        path = as_path('path', path)
        folder = path if path.is_dir() else path.parent if path.name == SCENE else None
        file = path if folder is None else folder / CHECKPOINT
        if not file.exists():
            raise InputError(
                f'{path}: there is no fit here; give a folder that lm.fit or Fit.save wrote, or its {CHECKPOINT}'
            )
        if folder is not None:
            require_together(folder, [SCENE, CLOUD, CHECKPOINT])
        stored = Checkpoint.load(file)
        if stored.searching:
            raise InputError(
                f'{file}: the fit still searches for the step to stop at, and has no result: let it go on, with resume=True'
            )
        effects = None
        if stored.effects:
            effects = _effects_of(folder, file)
        stored.state.values |= average.values_of(stored.arrays)
        model = stored.method.model(stored.geometry, stored.unit, effects)
        if model.response is not None:
            model.response.restore(stored.arrays)
        fit = cls(stored, model, folder=folder)
        fit._stored  # noqa: B018 - damaged numbers are an error here, not later
        return fit

    def with_data(self, data: Dataset | None) -> Fit:
        """The same fit beside other held-out views, or another true volume.

        Parameters
        ----------
        data : Dataset or None
            The data to compare with.

        Returns
        -------
        Fit
            With the same model.

        Examples
        --------
        `fit.with_data(data).view()`
        """
        return Fit(self.checkpoint, self.model, data)

    # ---- numbers ----

    @cached_property
    def numbers(self) -> dict:
        """All numbers, with the history. A loaded fit has the saved numbers where it lacks a truth."""
        numbers = fit_metrics(self)
        if self.data is None and self._stored:
            missing = {k: self._stored.get(k) for k, value in numbers.items() if value is None}
            numbers |= _scalars(missing)
        return numbers

    @property
    def record(self) -> dict:
        """The record in metrics.json, of a loaded fit or of one not yet saved: `numbers`, method and settings, scan, software."""
        return self._stored if self.data is None and self._stored else self.numbers | description(self)

    def metrics(self, data: Dataset | None = None) -> dict[str, float | None]:
        """PSNR and SSIM of held-out views and volume, IPSD, times.

        The full scale of `psnr_2d`, `ssim_2d`, `psnr_3d` and `ssim_3d` is the largest true value. Names that end in `_r2`
        follow R2-Gaussian's published tables: views are divided by their own maxima, and the full scale of densities is 1.

        Parameters
        ----------
        data : Dataset, optional
            The data to compare with (default: the data that `lm.fit` received; a loaded fit returns the saved numbers).

        Returns
        -------
        dict[str, float or None]
            Numbers by name, in dB, seconds or none of these; None without a truth to compare with.

        Examples
        --------
        `fit.metrics()['psnr_3d']`
        """
        if data is not None:
            require_type('data', data, Dataset, 'write lm.Dataset(scan, test, volume)')
            return _scalars(fit_metrics(self.with_data(data)))
        if self.data is None and self._stored is not None:
            return _scalars(self._stored)
        return _scalars(self.numbers)

    # ---- files and pages ----

    def save_volume(
        self,
        path: str | PathLike,
        grid: Grid | None = None,
        *,
        units: str = '1/mm',
        mu_water: float | None = None,
        slab: int = THICKNESS,
        cluster: Any = None,
        force: bool = False,
    ) -> Path:
        """Write `volume` slab by slab, so that it need not fit into memory.

        Parameters
        ----------
        path : path
            .nii, .nii.gz, a new .ome.zarr, or a new folder .dicom; its folder is made.
        grid : Grid, optional
            Grid of the voxels (default: the scan's); `scan.geometry.grid.finer(2)` has smaller ones.
        units, mu_water
            Unit of the values in the file: '1/mm', '1/cm', or 'hu' with the attenuation of water in 1/mm.
        slab : int
            Slices that are in memory at once.
        cluster : str or Client, optional
            Let the workers of a Dask cluster write the slabs of an .ome.zarr, as `lm.reconstruct` does.
        force : bool
            Replace an earlier file.

        Returns
        -------
        Path
            The path of the file.

        Raises
        ------
        InputError
            As `volume`, and if the file exists already or cannot be written.

        Examples
        --------
        `fit.save_volume('foot.ome.zarr', lm.Grid(2048, 0.125))`
        """
        path, slab = as_path('path', path), whole_number('slab', slab, 1)
        voxels, unit = self._grid(grid), unit_of(units, mu_water)
        with writing(path):
            new_file(path, force)
        if cluster is None:
            write_slabs(path, voxels, (self.volume(voxels.slab(*part)) for part in voxels.slabs(slab)), unit)
        else:
            require_whole_chunks(path, slab, unit)
            with workers(cluster, path) as runner:
                voxelize_on(runner, self, voxels, slab, path.absolute())
        return path

    def save(
        self,
        folder: str | PathLike,
        *,
        title: str = '',
        units: str = '1/mm',
        mu_water: float | None = None,
        force: bool = False,
        note: dict | None = None,
    ) -> Path:
        """Write volume.nii.gz, gaussians.ply, result.xml, views, metrics.json, the report and checkpoint.npz.

        Parameters
        ----------
        folder : path
            The folder; it is made if it is missing.
        title : str
            Title of the report (default: the folder's name).
        units, mu_water
            Unit of the values in volume.nii.gz: '1/mm', '1/cm', or 'hu' with the attenuation of water in 1/mm.
        force : bool
            Replace an earlier result; other files in the folder are left alone.
        note : dict, optional
            Further entries of metrics.json, such as the `command` that makes the result again.

        Returns
        -------
        Path
            The path of the folder.

        Raises
        ------
        InputError
            If the folder holds files already, cannot be written, or another process writes to it.
        """
        folder, unit = as_path('folder', folder), unit_of(units, mu_water)
        with writing(folder):
            if folder.is_dir() and occupants(folder) and not force:
                raise InputError(f'{folder}: is not empty; give force=True to replace an earlier result')
        self.numbers  # noqa: B018 - takes a while, and may fail: before anything is touched
        with locked(folder), writing(folder):
            clear_leftovers(folder)
            require_ours(folder, result_names(self.method, len(self.view_angles)) | {CHECKPOINT})
            self.checkpoint.save(folder / CHECKPOINT)
            self.write(folder, title or folder.name, note, unit)
        return folder

    def write(self, folder: Path, title: str, note: dict | None = None, unit: Unit = PER_MM) -> None:
        """Write the files of `save` without the checkpoint, into an existing folder that this process has locked.

        Parameters
        ----------
        folder : Path
            The folder.
        title : str
            Title of the report.
        note : dict, optional
            Further entries of metrics.json.
        unit : Unit
            Unit of the values in volume.nii.gz.
        """
        write_fit(folder, self, self.numbers | (note or {}), lambda numbers: self.report(title, numbers), unit)

    def report(self, title: str = '', numbers: dict | None = None) -> ReportData:
        """Return the contents of the report.

        Parameters
        ----------
        title : str
            Title (default: the method's name).
        numbers : dict, optional
            Numbers to show in place of `numbers`.

        Returns
        -------
        ReportData
            Volume, views, cloud, history and numbers.
        """
        test = None if self.data is None else self.data.test
        angles = np.array(self.view_angles)
        more: dict[str, Any] = {}
        if self.views is not None:
            truth = None if test is None else test.projections
            views = self.views if test is None else comparable(self.views, test)
            more = dict(views=views, views_truth=truth, views_angles=angles)
        if self.method.makes_gaussians:
            means, scales, quaternions, density = self.gaussians
            more |= dict(cloud_centres=means, cloud_density=density, cloud_scales=scales, cloud_quaternions=quaternions)
        numbers = self.numbers if numbers is None else numbers
        scanner, has_volume = self.nominal_geometry, self.method.makes_volume
        return ReportData(
            title=title or self.method.name,
            metrics=numbers if self.method.makes_gaussians else _without_gaussians(numbers),
            volume=self.scan_volume if has_volume else None,
            truth=self.data.volume if has_volume and self.data is not None else None,
            shape=scanner.grid.shape,
            spacing=scanner.grid.spacing,
            centre=scanner.grid.centre,
            pixel=scanner.dDetector,
            scanner=self.geometry,
            cloud_unit='' if has_volume else 'opacity',
            command=numbers.get('command', ''),
            **more,
        )

    def view(self, *, title: str = '') -> Page:
        """Make the interactive page of the fit: linked slices, held-out views, curves, the cloud in 3D, all numbers.

        Parameters
        ----------
        title : str
            Title of the page (default: the method's name).

        Returns
        -------
        Page
            The report.html of `save`, 1 to 30 MB. As the last line of a notebook's cell it shows itself there. Elsewhere
            `page.open()` opens it in the browser, and `page.save('foot.html')` writes it.

        Examples
        --------
        `fit.view().save('foot.html')`
        """
        return Page(report_page(self.report(title)))

    def __repr__(self) -> str:
        size = sum(v.size for v in self.state.values.values())
        what = f'{len(self):,} Gaussians' if self.method.makes_gaussians else f'a field of {size:,} parameters'
        return f'Fit({self.method.name}: {what} after {self.steps} iterations, {self.seconds:.0f} s)'

    def _repr_html_(self) -> str:
        geometry, parts = self.nominal_geometry, []
        if self.method.makes_volume:
            parts += [notebook.slices(self.scan_volume, geometry.grid.spacing, geometry.grid.centre), '<br>']
        test = None if self.data is None else self.data.test
        if self.views is not None and test is not None:
            labels = [f'held-out view {i}, at {a:.1f}°' for i, a in enumerate(self.view_angles)]
            for title, images in (('Rendered', self.views), (self.report().reference, test.projections)):
                parts.append(notebook.frames(images, labels, title))
        picture = overview(self.report(), headline(self.metrics()))
        embedded = base64.b64encode(picture).decode('ascii')
        parts.append(
            f'<br><img alt="{html.escape(repr(self))}" style="max-width: 100%" src="data:image/png;base64,{embedded}">'
        )
        return notebook.box(f'{self!r}:  {headline(self.metrics())}', *parts)


def load_fit(path: str | PathLike) -> Fit:
    """Load a fit from a folder or from a checkpoint; see `Fit.load`.

    Parameters
    ----------
    path : path-like
        A folder that `Fit.save` or the command line wrote, or a checkpoint (.npz) alone.

    Returns
    -------
    Fit
        Without the scan's data.

    Raises
    ------
    InputError
        If there is no result, if it is damaged, or if files do not belong together.

    Examples
    --------
    `fit = lm.load_fit('out/foot')`
    """
    return Fit.load(path)


def _effects_of(folder: Path | None, checkpoint: Path) -> Effects | None:
    """The effects that a fit has modelled, which stand in the scene of its folder."""
    scene = None if folder is None else folder / SCENE
    if scene is None or not scene.exists():
        raise InputError(
            f'{checkpoint}: the fit has modelled effects of its scan, which a checkpoint does not hold: load the folder of its '
            f'result, whose {SCENE} has them'
        )
    loaded = load_scene(scene)
    return find_effects(loaded.scene, loaded.scanner)


def _scalars(numbers: dict) -> dict[str, float | None]:
    return {name: value for name, value in numbers.items() if value is None or isinstance(value, int | float)}


def _without_gaussians(numbers: dict) -> dict:
    """Numbers of a neural field without those that only a cloud has, as a report shows them."""
    of_clouds = {'ipsd', 'ipsd_targets', 'ipsd_reverse', 'gaussians'}
    history = [{k: v for k, v in entry.items() if k not in of_clouds} for entry in numbers['history']]
    return {k: v for k, v in numbers.items() if k not in of_clouds} | dict(history=history)
