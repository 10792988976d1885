"""The files of a fit: volume, cloud or field, scene, views, measurements, report."""

from __future__ import annotations

import platform
import time
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError, brief
from lingo_mi.files.images import write_exr
from lingo_mi.files.ply import write_ply, write_radiance_ply
from lingo_mi.files.units import PER_MM, Unit
from lingo_mi.files.volumes import write_volume
from lingo_mi.fitting.fitted_model import FittedModel
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.cloud_method import CloudMethod
from lingo_mi.fitting.models.alpha import harmonics
from lingo_mi.fitting.scene_file import write_scene
from lingo_mi.report.data import ReportData
from lingo_mi.report.page import write_report
from lingo_mi.storage.file_access import writing
from lingo_mi.storage.output_folder import (
    CHECKPOINT,
    CLOUD,
    METRICS,
    PAGE,
    PICTURE,
    SCENE,
    VIEWS,
    VOLUME,
    begin,
    complete_result,
    remove_others,
    view_name,
)


def write_fit(
    folder: Path, fit: FittedModel, numbers: dict, report: Callable[[dict], ReportData], unit: Unit = PER_MM
) -> dict:
    """Write all files of a fit but its checkpoint into `folder`, and return the numbers.

    These are `volume.nii.gz`, `gaussians.ply`, `result.xml`, `views/`, `report.png`, `report.html` and `metrics.json`. Files of
    an earlier result are replaced or removed, others are left alone. metrics.json is removed first and written last. It has a
    digest of all others and of the checkpoint beside them, so that it marks a complete result (see `output_folder`).

    For alpha compositing there is no volume, and no scene, because no integrator renders it. For a neural field there is no
    cloud: the scene is of its volume, and the field itself is in the checkpoint.

    Parameters
    ----------
    folder : Path
        An existing folder, which no other process writes to, with the fit's checkpoint.
    numbers : dict
        For metrics.json.
    report : callable
        The contents of the report with all numbers. A report that cannot be drawn is a warning.
    unit : Unit
        Unit of the values in the volume's file.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    geometry, method = fit.nominal_geometry, fit.method
    names = result_names(method, 0 if fit.views is None else len(fit.views))
    begin(folder, names)
    names |= {CHECKPOINT}
    remove_others(folder, names)
    if method.makes_volume:
        write_volume(folder / VOLUME, unit.values(fit.scan_volume), geometry.grid, unit.description)
        if method.makes_gaussians:
            means, scales, quaternions, density = fit.gaussians
            write_ply(folder / CLOUD, means, scales, quaternions, density, fit.shares())
        extent = method.extent if isinstance(method, CloudMethod) else None
        write_scene(folder / SCENE, fit.geometry, extent, fit.model.effects)
    else:
        means, scales, quaternions, opacity = fit.gaussians
        write_radiance_ply(folder / CLOUD, means, scales, quaternions, opacity, *harmonics(fit.state.values))
    if fit.views is not None:
        _write_views(folder, fit.views)
    numbers = numbers | description(fit)
    try:
        write_report(folder, report(numbers))
    except InputError:  # for example, the disk is full
        raise
    except Exception as error:  # libraries that draw may fail: the numbers are worth more than their picture
        warnings.warn(
            f'{folder}: the report could not be drawn ({brief(error, 150)}); all else is written', stacklevel=2
        )
        names -= {PICTURE, PAGE}
        remove_others(folder, names)
    return complete_result(folder, names - {METRICS}, numbers, default=np.generic.item)


def description(fit: FittedModel) -> dict:
    """Return the content of metrics.json besides the numbers of a fit: method and settings, scan, corrections, software."""
    return dict(
        method=fit.method.name,
        seed=fit.checkpoint.seed,
        views=len(fit.nominal_geometry),
        variant=mi.variant(),
        settings=fit.method.flat(),
        initial=fit.info,
        **_corrections(fit),
        angles=np.degrees(fit.nominal_geometry.angles).tolist(),
        pixel=list(fit.nominal_geometry.dDetector),
        test_angles=fit.view_angles,
        versions=versions(),
    )


def result_names(method: Method, views: int) -> frozenset[str]:
    """The files that `Fit.save` writes of a fit by this method and of so many held-out views."""
    names = {PICTURE, PAGE, METRICS, *map(view_name, range(views))}
    return frozenset(
        names | ({CLOUD} if method.makes_gaussians else set()) | ({VOLUME, SCENE} if method.makes_volume else set())
    )


def _write_views(folder: Path, rendered: np.ndarray):
    """Write one image per view."""
    with writing(folder):
        (folder / VIEWS).mkdir(exist_ok=True)
    for i, image in enumerate(rendered):
        write_exr(folder / view_name(i), image)


def _corrections(fit: FittedModel) -> dict:
    """Return the fitted corrections in readable units: the response (levels, per cent), and the corrections of the views'
    poses as rotation vectors and shifts about the volume's centre."""
    poses, response = fit.poses, fit.model.response
    numbers = {} if response is None else dict(response=response.report())
    if poses is None:
        return numbers
    return numbers | dict(
        pose_turns_degrees=np.degrees(poses.turn).tolist(),
        pose_shifts_mm=(poses.shift / fit.nominal_geometry.grid.scale).tolist(),
    )


def versions() -> dict:
    """Versions of the software that computed a result."""
    return dict(
        python=platform.python_version(),
        **{name: version(name) for name in ('lingo_mi', 'mitsuba', 'drjit', 'numpy', 'scipy', 'scikit-image')},
        date=time.strftime('%Y-%m-%d'),
    )
