"""The content of a report, checked: numbers, volume, views, cloud, scanner."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, brief
from lingo_mi.geometry.base import Geometry

OPAQUE = 20.0  # a line integral that no detector measures: of 5e8 photons, one comes through
REAL, X3D = 'density [1/mm]', "density [X3D's scale, 0 to 1]"


def quantity_of(volume: np.ndarray, spacing: ArrayLike) -> str:
    """Return the quantity of a volume [x, y, z]: attenuation per mm, or densities on X3D's scale, which no scanner could
    measure."""
    along = [float(volume.sum(i, dtype=float).max() * step) for i, step in enumerate(np.asarray(spacing))]
    return REAL if max(along) < OPAQUE else X3D


@dataclass(frozen=True, eq=False)
class ReportData:
    """The contents of a report. Only `title`, `metrics`, `volume` (or `shape`) and `spacing` are needed.

    title           of the report: any text, shown as it is, on one line of printable characters
    metrics         the numbers, by the keys of QUALITY and SETTINGS. None and NaN are left out; other scalar
                    entries are listed with the settings. `history` is a list of dicts with `iteration`,
                    `seconds`, `loss`, `psnr_2d`, `psnr_3d` and `gaussians`; each may be missing or None.
                    `residual_by_view` is a list of the residual of each of `views`, rms
    volume          [x, y, z] density, 1/mm or on X3D's scale (`quantity`); None for a cloud without densities
    shape           its voxels, (x, y, z); by default the shape of `volume`
    spacing         voxel size, (x, y, z), mm
    truth           the true volume, as `volume`; None for measured data
    preview         n, if each voxel of `volume` and `truth` is the mean of n^3 of the grid that `shape` and `spacing` describe
    error_map       how far off the volume may be, 1/mm (`reconstruction.best.error_map`), not negative, as `volume`; or None
    centre          of the volume, (x, y, z), mm
    views           [n, v, u] rendered held-out views: line integrals ln(I0/I)
    views_truth     [n, v, u] the same views as measured or simulated, or None
    views_angles    [n] degrees
    pixel           size of a detector pixel, (v, u), mm
    cloud_centres   [N, 3] centres of the Gaussians, mm
    cloud_density   [N] density at their centres, or the quantity that `cloud_unit` names
    cloud_scales    [N, 3] standard deviations, mm, and
    cloud_quaternions [N, 4] (x, y, z, w), for ellipsoids in place of points; None: points only
    scanner         the geometry of the fitted views, for the drawings of source and panel
    command         the command line that reproduces this result

    Raises
    ------
    InputError
        If shapes do not fit or an image holds NaN or infinity.
    """

    title: str
    metrics: dict
    volume: np.ndarray | None
    spacing: tuple[float, float, float]
    truth: np.ndarray | None = None
    shape: tuple[int, int, int] | None = None
    preview: int = 1
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    views: np.ndarray | None = None
    views_truth: np.ndarray | None = None
    views_angles: np.ndarray | None = None
    pixel: tuple[float, float] = (1.0, 1.0)
    cloud_centres: np.ndarray | None = None
    cloud_density: np.ndarray | None = None
    cloud_unit: str = ''
    cloud_scales: np.ndarray | None = None
    cloud_quaternions: np.ndarray | None = None
    scanner: Geometry | None = None
    command: str = ''
    error_map: np.ndarray | None = None
    history: list[dict] = field(init=False)

    @cached_property
    def quantity(self) -> str:
        """The quantity of the volume with its unit: see `quantity_of`."""
        volume = self.volume if self.truth is None else self.truth
        return REAL if volume is None else quantity_of(volume, self.preview * np.asarray(self.spacing))

    @property
    def reference(self) -> str:
        """The label of the views that rendered views are compared with. Views of a known object are usually simulated."""
        return 'Measured' if self.truth is None and self.quantity == REAL else 'Reference'

    def __post_init__(self):
        def fix(name, shape):
            value = getattr(self, name)
            if value is None:
                if name in ('views_angles', 'cloud_density'):
                    raise InputError(f'the report needs {name} of the shape {shape}')
                return
            value = np.asarray(value)
            if value.dtype not in (np.float32, np.float64):
                value = value.astype(float)
            if value.ndim != len(shape) or any(s is not None and n != s for n, s in zip(value.shape, shape)):
                wanted = tuple('n' if s is None else s for s in shape)
                raise InputError(f'{name} of the report has the shape {value.shape}, not {wanted}')
            if not np.isfinite(value).all():
                raise InputError(f'{name} of the report contains NaN or infinity')
            object.__setattr__(self, name, value)

        if self.volume is None and self.shape is None:
            raise InputError('the report needs a volume, or its shape')
        fix('volume', (None,) * 3)
        if self.volume is not None:
            if self.preview == 1:
                object.__setattr__(self, 'shape', self.volume.shape)
            fix('truth', self.volume.shape)
            fix('error_map', self.volume.shape)
        for name, n in (('spacing', 3), ('centre', 3), ('pixel', 2)):
            fix(name, (n,))
        fix('views', (None,) * 3)
        if self.views is not None:
            fix('views_truth', self.views.shape)
            fix('views_angles', (len(self.views),))
        fix('cloud_centres', (None, 3))
        if self.cloud_centres is not None:
            fix('cloud_density', (len(self.cloud_centres),))
            fix('cloud_scales', self.cloud_centres.shape)
            fix('cloud_quaternions', (len(self.cloud_centres), 4))
        for name in ('volume', 'views'):
            if getattr(self, name) is not None and getattr(self, name).size == 0:
                raise InputError(f'{name} of the report is empty')
        if not self.cloud_unit:
            object.__setattr__(self, 'cloud_unit', self.quantity.replace('density', 'density at the centre'))
        object.__setattr__(self, 'title', brief(self.title, 120))
        object.__setattr__(self, 'history', list(self.metrics.get('history') or []))
