"""What a fit gives: Gaussians, a volume, new views, numbers, files."""

from __future__ import annotations

import base64
import html
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lingo_mi.common import notebook
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import whole
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.effects.forward import find_effects
from lingo_mi.files.slabs import THICKNESS, write_slabs
from lingo_mi.fitting.fitted import Fitted, NeedsEffects
from lingo_mi.fitting.settings import Settings
from lingo_mi.geometry import Geometry
from lingo_mi.metrics.quality import current_names
from lingo_mi.report.figures import overview
from lingo_mi.report.numbers import headline
from lingo_mi.report.page import report_page
from lingo_mi.report.view import Page
from lingo_mi.results.measure import Measured, measure
from lingo_mi.results.save import report_data, result_names, save
from lingo_mi.scan import Dataset
from lingo_mi.scene.load import load_scene
from lingo_mi.storage.file_access import as_path, new_file, parsed_json, reading, replacing, writing
from lingo_mi.storage.folder_lock import locked
from lingo_mi.storage.output_folder import (
    CHECKPOINT,
    CLOUD,
    METRICS,
    SCENE,
    begin,
    clear_leftovers,
    occupants,
    require_ours,
    require_together,
)


class Gaussians(NamedTuple):
    """A cloud of N Gaussians in the world frame of the scan, ready for `lm.project` and `lm.voxelize`.

    means        float [N, 3], mm
    scales       float [N, 3], standard deviations, mm
    quaternions  float [N, 4], (x, y, z, w), unit length
    density      float [N], value at the centre, 1/mm (of the baselines '3dgs' and 'xgaussian': opacity)
    """

    means: np.ndarray
    scales: np.ndarray
    quaternions: np.ndarray
    density: np.ndarray


class Result:
    """The result of `lm.fit`, or of `lm.load_result`. In a notebook it shows slices, views, curves and numbers.

    result = lm.fit(data, 'fast')
    result.volume()                     # float32 [x, y, z], density per mm
    result.render(data.test.geometry)   # float32 [view, v, u], line integrals
    result.metrics()['psnr_3d']
    result.save('out/foot')
    """

    def __init__(
        self, fitted: Fitted, recipe: str, checkpoint: bytes, data: Dataset | None = None, stored: dict | None = None
    ):
        """checkpoint: of the finished fit; data: the scan and what is held out; stored: metrics as they were saved."""
        self.fitted, self.recipe, self.data = fitted, recipe, data
        self._checkpoint, self._stored = checkpoint, stored

    @property
    def settings(self) -> Settings:
        """The settings of the fit, with the bounds that the scan sets."""
        return self.fitted.settings

    @property
    def geometry(self) -> Geometry:
        """The scan's geometry, with poses as the fit has corrected them."""
        return self.fitted.corrected

    @property
    def history(self) -> list[dict]:
        """Measurements over time: iteration, seconds, loss, gaussians, and PSNR where it was measured."""
        return self.fitted.history

    @property
    def seconds(self) -> float:
        """Time to start and to fit."""
        return self.fitted.info['seconds'] + self.fitted.seconds

    @property
    def gaussians(self) -> Gaussians:
        """The cloud, for `lm.project(*result.gaussians, geometry)`.

        With `extent=result.settings.model.extent` images are those of `render`. Raises InputError for 'naf', a neural field.
        """
        return Gaussians(*self.fitted.world_gaussians())

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.asarray(self.volume(), dtype)

    def __len__(self) -> int:
        return len(self.fitted.state)

    def volume(self, geometry: Geometry | None = None) -> np.ndarray:
        """The density at the voxel centres of a geometry's grid (default: the scan's), float32 [x, y, z], per mm.

        Raises InputError for the baselines '3dgs' and 'xgaussian', whose opacities are no densities.
        """
        if geometry is not None:
            require_type('geometry', geometry, Geometry, 'scan.geometry.with_volume(nVoxel, dVoxel) has another grid')
        volume = self.fitted.volume(geometry)
        if volume is None:
            raise InputError(
                f'{self.recipe} fits opacities, not densities, and has no volume: take '
                'lm.reconstruct(scan, algorithm, start=result, views=N)'
            )
        return volume

    def save_volume(
        self, path: str | PathLike, geometry: Geometry | None = None, *, slab: int = THICKNESS, force: bool = False
    ) -> Path:
        """Write `volume` slab by slab, so that it need not fit into memory; returns the path.

        path       .nii, .nii.gz, or a new .ome.zarr; its folder is made
        geometry   whose grid (default: the scan's); `scan.geometry.with_volume(nVoxel, dVoxel)` has a finer one
        slab       slices that are in memory at once
        force      replace an earlier file

        Raises InputError as `volume`, and where the file is there already or cannot be written.

            result.save_volume('foot.ome.zarr', scan.geometry.with_volume(2048, 0.125))
        """
        path, slab = as_path('path', path), whole('slab', slab, 1)
        if geometry is not None:
            require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
        with writing(path):
            new_file(path, force)
        grid = self.fitted.geometry if geometry is None else geometry
        write_slabs(path, grid, (self.volume(grid.slab(*part)) for part in grid.slabs(slab)))
        return path

    def render(self, geometry: Geometry | None = None) -> np.ndarray:
        """Line integrals in the views of any geometry (default: the scan's), float32 [view, v, u], density times mm.

        Where the fit has modelled effects, what the scan's detector would see, noise apart.
        """
        if geometry is not None:
            require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
        return self.fitted.render(self.geometry if geometry is None else geometry)

    @cached_property
    def _measured(self) -> Measured:
        if self.data is not None:
            return measure(self.fitted, self.data.test, self.data.volume)
        measured = measure(self.fitted)
        known = self._numbers(self._stored or {})  # what there is no truth for now was measured when there was one
        unknown = {name: known.get(name) for name, value in measured.numbers.items() if value is None}
        return replace(measured, numbers=measured.numbers | unknown)

    @staticmethod
    def _numbers(found: dict) -> dict[str, float | None]:
        return {name: value for name, value in found.items() if value is None or isinstance(value, int | float)}

    def metrics(self, data: Dataset | None = None) -> dict[str, float | None]:
        """PSNR and SSIM of held-out views and volume, IPSD, times; None where there is no truth to compare with.

        data   what to compare with (default: what was given to `lm.fit`; of a loaded result, the numbers as saved)

        The full scale of `psnr_2d`, `ssim_2d`, `psnr_3d` and `ssim_3d` is the largest true value. Those that end in `_r2` are
        R2-Gaussian's, as published tables have them: views divided by their own maxima, and 1 for densities.
        """
        if data is not None:
            require_type('data', data, Dataset, 'write lm.Dataset(scan, test, volume)')
            numbers = measure(self.fitted, data.test, data.volume).numbers
        else:
            numbers = self._measured.numbers if self._stored is None else self._stored
        return self._numbers(numbers)

    def save(self, folder: str | PathLike, *, title: str = '', force: bool = False) -> Path:
        """Write volume.nii.gz, gaussians.ply, result.xml, views, metrics.json, the report and checkpoint.npz; returns the folder.

        title   of the report (default: the folder's name)
        force   replace an earlier result; other files in the folder are left alone

        Of a loaded result, metrics.json keeps the comparison with the truth; the held-out views are not in it.
        Raises InputError where the folder holds files already, cannot be written, or another process writes to it.
        """
        folder = as_path('folder', folder)
        with writing(folder):
            if folder.is_dir() and occupants(folder) and not force:
                raise InputError(f'{folder}: is not empty; give force=True to replace an earlier result')
        measured = self._measured  # takes a while, and may fail: before anything is touched
        views = 0 if measured.views is None else len(measured.views)
        with locked(folder), writing(folder):
            clear_leftovers(folder)
            require_ours(folder, result_names(self.settings, views) | {CHECKPOINT})
            with replacing(folder / CHECKPOINT) as temporary:
                temporary.write_bytes(self._checkpoint)
                begin(folder, [CHECKPOINT])
            save(folder, self.fitted, measured, title=title or folder.name, method=self.recipe)
        return folder

    def __repr__(self) -> str:
        size = sum(v.size for v in self.fitted.state.values.values())
        what = f'{len(self):,} Gaussians' if self.settings.cloud else f'a field of {size:,} parameters'
        return f'Result({self.recipe}: {what} after {self.fitted.steps} iterations, {self.seconds:.0f} s)'

    def _repr_html_(self) -> str:
        measured, geometry = self._measured, self.fitted.geometry
        parts = []
        if measured.volume is not None:
            parts += [notebook.slices(measured.volume, geometry.dVoxel, geometry.offOrigin), '<br>']
        if measured.views is not None and measured.test is not None:
            angles = [
                f'held-out view {i}, at {a:.1f}°' for i, a in enumerate(np.degrees(measured.test.geometry.angles))
            ]
            for title, images in (('Rendered', measured.views), ('Measured', measured.test.projections)):
                parts.append(notebook.frames(images, angles, title))
        picture = overview(report_data(self.fitted, measured, self.recipe), headline(self.metrics()))
        embedded = base64.b64encode(picture).decode('ascii')
        parts.append(
            f'<br><img alt="{html.escape(repr(self))}" style="max-width: 100%" src="data:image/png;base64,{embedded}">'
        )
        return notebook.box(f'{self!r}:  {headline(self.metrics())}', *parts)

    def view(self, *, title: str = '') -> Page:
        """The interactive page of the result: linked slices, held-out views, curves, the cloud in 3D, all numbers.

        title   of the page (default: the recipe's name)

        Returns a `Page`: as the last line of a notebook's cell it shows itself there; elsewhere `page.open()` opens it in the
        browser, and `page.save('foot.html')` writes it. It is the report.html of `save`, 1 to 30 MB.

            result.view().open()
        """
        return Page(report_page(report_data(self.fitted, self._measured, title or self.recipe)))


def load_result(path: str | PathLike) -> Result:
    """A result from the folder that `Result.save` or the command line wrote, or from a checkpoint (.npz) alone.

    Raises InputError where there is no result, or it is damaged, or of files that do not belong together.

        result = lm.load_result('out/foot')
    """
    ensure_variant()
    path = as_path('path', path)
    file = path / CHECKPOINT if path.is_dir() else path
    if not file.exists():
        raise InputError(
            f'{path}: there is no result here; give a folder that Result.save or lingo-mi fit wrote, or its {CHECKPOINT}'
        )
    if path.is_dir():
        require_together(path, [SCENE, CLOUD, CHECKPOINT])
    try:
        fitted = Fitted.from_checkpoint(file)
    except NeedsEffects:
        if not (path / SCENE).exists():
            raise
        loaded = load_scene(path / SCENE)
        fitted = Fitted.from_checkpoint(file, find_effects(loaded.scene, loaded.scanner))
    numbers = file.with_name(METRICS)
    stored = None
    if path.is_dir() and numbers.exists():
        try:
            with reading(numbers):
                stored = current_names(parsed_json(numbers.read_text(encoding='utf-8')))
        except (ValueError, AttributeError):  # no JSON, or no dictionary
            raise InputError(f'{numbers}: is damaged; remove it, and give metrics() the data to compare with') from None
    return Result(fitted, (stored or {}).get('method', 'checkpoint'), file.read_bytes(), stored=stored)
