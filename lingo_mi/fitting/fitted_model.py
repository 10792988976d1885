"""The result of a fit: a model and its state, which can be rendered and voxelized."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.runtime import drjit_lock
from lingo_mi.files.images import read_exr
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.models.model import Model
from lingo_mi.fitting.state import State
from lingo_mi.functional.gaussians import Gaussians
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.projectors import cutoff
from lingo_mi.projectors.objects import Ellipsoids
from lingo_mi.scan import Dataset
from lingo_mi.storage.file_access import parsed_json, reading
from lingo_mi.storage.output_folder import METRICS, VIEWS, require_together


class FittedModel:
    """A model at the state of a fit, with the views that were held out of it."""

    def __init__(self, checkpoint: Checkpoint, model: Model, data: Dataset | None = None, folder: Path | None = None):
        """model: of the checkpoint's method; folder: that the fit was loaded from."""
        self.checkpoint, self.model, self.data, self.folder = checkpoint, model, data, folder
        self.poses = checkpoint.method.poses(checkpoint.geometry)
        if self.poses is not None:
            self.poses.restore(checkpoint.arrays)

    # ---- what was fitted ----

    @property
    def method(self) -> Method:
        """With the limits that the scan sets."""
        return self.checkpoint.method

    @property
    def state(self) -> State:
        """All parameters, on the host."""
        return self.checkpoint.state

    @property
    def history(self) -> list[dict]:
        """Measurements over time: iteration, seconds, loss, gaussians, and PSNR if it was measured."""
        return self.checkpoint.history

    @property
    def info(self) -> dict:
        """Measurements of the start."""
        return self.checkpoint.info

    @property
    def search(self) -> dict | None:
        """Record of the search for the last step (`fitting.stopping`); None without a search."""
        return self.checkpoint.search

    @property
    def steps(self) -> int:
        """Steps that were done: fewer than the method's iterations if the fit runs or has stopped early."""
        return self.checkpoint.iteration

    @property
    def seconds(self) -> float:
        """Time to start and to fit."""
        return self.info.get('seconds', 0.0) + self.checkpoint.seconds

    @property
    def nominal_geometry(self) -> Geometry:
        """The scan's geometry, as given."""
        return self.checkpoint.geometry

    @property
    def geometry(self) -> Geometry:
        """The scan's geometry, with poses as the fit has corrected them."""
        return self.nominal_geometry if self.poses is None else self.poses.corrected(self.nominal_geometry)

    def __len__(self) -> int:
        return len(self.state)

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.asarray(self.volume(), dtype)

    @property
    def gaussians(self) -> Gaussians:
        """The cloud, with its cut-off: `lm.project(fit.gaussians, geometry)`.

        Raises
        ------
        InputError
            For a field.
        """
        arrays = self.model.gaussians(self._device)
        return Gaussians(*arrays, extent=getattr(self.method, 'extent', cutoff.RENDER))

    @property
    def _device(self) -> DeviceState:
        return DeviceState(self.state)

    # ---- images and volumes ----

    @drjit_lock()
    def render(
        self, geometry: Geometry | None = None, progress: Callable[[int, int], None] | None = None
    ) -> np.ndarray:
        """Projections in the views of any geometry (default: the scan's), float32 [view, v, u], density times mm.

        They are line integrals, or, if the fit has modelled effects, what the scan's detector would see without noise.
        """
        return self.model.render(self._device, self._checked(geometry, self.geometry), progress)

    @drjit_lock()
    def line_integrals(self, geometry: Geometry) -> np.ndarray:
        """Line integrals in the views of a geometry, float32 [view, v, u], without the effects that the fit has modelled."""
        return self.model.line_integrals(self._device, geometry)

    @drjit_lock()
    def expected(self, geometry: Geometry) -> np.ndarray:
        """Return the values that the scan's detector is expected to measure, float32 [view, v, u]. The views were taken during
        the scan.

        That is `render`, with the response and with the smooth corrections of poses that were fitted, for the time of the views.
        """
        if self.poses is not None:
            geometry = self.poses.between(self.nominal_geometry, geometry)
        return self.model.expected(self._device, geometry)

    @drjit_lock()
    def volume(self, grid: Grid | None = None) -> np.ndarray:
        """The density at the voxel centres of a grid (default: the scan's), float32 [x, y, z], per mm.

        Raises
        ------
        InputError
            For `GaussianSplatting` and `XGaussian`, whose opacities are not densities.
        """
        return self.model.volume(self._device, None if grid is None else self._grid(grid))

    @cached_property
    def scan_volume(self) -> np.ndarray:
        """`volume` on the scan's grid, computed once for all that measures, shows and saves it. Do not write to it."""
        return self.volume()

    @drjit_lock()
    def cloud(self) -> Ellipsoids | None:
        """The Gaussians in mm, densities in 1/mm, as an object of a scene; None without densities."""
        return self.model.cloud(self._device)

    @drjit_lock()
    def shares(self) -> np.ndarray | None:
        """The second material's share in every Gaussian's density, float32 [N]; None for one material."""
        share = self.model.shares(self._device)
        return None if share is None else share.numpy()

    @cached_property
    def views(self) -> np.ndarray | None:
        """The held-out views, rendered, float32 [view, v, u]; of a loaded fit, as they were saved. None if there are none."""
        if self.data is not None:
            test = self.data.test
            return None if test is None or not len(test) else self.expected(test.geometry)
        if self.folder is None:
            return None
        files = sorted((self.folder / VIEWS).glob('*.exr'))
        if not files or len(files) != len(self.view_angles):
            return None
        require_together(self.folder, [f'{VIEWS}/{file.name}' for file in files])
        images = [read_exr(file) for file in files]
        if len({image.shape for image in images}) > 1:
            raise InputError(f'{self.folder / VIEWS}: the views are of several sizes; fit again')
        return np.stack(images)

    @property
    def view_angles(self) -> list[float]:
        """Angles of the held-out views, degrees."""
        if self.data is not None:
            return [] if self.data.test is None else np.degrees(self.data.test.geometry.angles).tolist()
        return (self._stored or {}).get('test_angles') or []

    @cached_property
    def _stored(self) -> dict | None:
        """Content of the folder's metrics.json; None without one."""
        file = None if self.folder is None else self.folder / METRICS
        if file is None or not file.exists():
            return None
        try:
            with reading(file):
                numbers = parsed_json(file.read_text(encoding='utf-8'))
            [float(angle) for angle in numbers.get('test_angles') or []]
        except (TypeError, ValueError, AttributeError) as error:  # no JSON, or no dictionary
            if isinstance(error, InputError):
                raise
            raise InputError(f'{file}: is damaged; remove it, and give metrics() the data to compare with') from None
        return numbers

    def _grid(self, grid: Grid | None) -> Grid:
        if grid is None:
            return self.nominal_geometry.grid
        require_type('grid', grid, Grid, 'of a scan give scan.geometry.grid')
        return grid

    @staticmethod
    def _checked(geometry: Geometry | None, default: Geometry) -> Geometry:
        if geometry is None:
            return default
        require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
        return geometry
