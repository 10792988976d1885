"""The files of a fit: volume, cloud or field, scene, views, measurements, report."""

from __future__ import annotations

import platform
import time
import warnings
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError, brief
from lingo_mi.files.images import write_exr
from lingo_mi.files.ply import write_ply, write_radiance_ply
from lingo_mi.files.volumes import first_voxel, write_volume
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.models.alpha import harmonics
from lingo_mi.fitting.settings import Settings
from lingo_mi.report.data import ReportData
from lingo_mi.report.page import write_report
from lingo_mi.results.measure import Measured, comparable
from lingo_mi.results.scene_file import write_scene
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
    complete,
    remove_others,
    view_name,
)


def save(
    folder: Path,
    fitted: Fitted,
    measured: Measured,
    *,
    title: str = 'fit',
    method: str = '',
    command: str = '',
    request: dict | None = None,
) -> dict:
    """Write all files into `folder` and return the metrics: `volume.nii.gz`, `gaussians.ply`, `result.xml`, `views/`,
    `report.png`, `report.html`, `metrics.json`. Files of an earlier result are replaced or removed, others are left alone.
    metrics.json goes first and comes last, with a digest of all others and of the checkpoint beside them, so that it marks a
    whole result (see `output_folder`). A report that cannot be drawn is a warning.

    folder     an existing folder, which no other process writes to
    measured   the measured fit
    title      of the report
    method     the recipe's name, for metrics.json and the report
    command    the command line that reproduces the result, for the same
    request    what was asked for, if metrics.json is to say so

    For alpha compositing there is no volume, and no scene, because no integrator renders it. For a neural field there is no
    cloud: the scene is of its volume, and the field itself is in the checkpoint.
    Raises InputError if a file cannot be written.
    """
    geometry, settings = fitted.geometry, fitted.settings
    names = result_names(settings, 0 if measured.views is None else len(measured.views))
    begin(folder, names)
    if (folder / CHECKPOINT).exists():
        names |= {CHECKPOINT}
    remove_others(folder, names)
    if measured.volume is None:
        write_radiance_ply(folder / CLOUD, *fitted.world_gaussians(), *harmonics(fitted.state.values))
    else:
        write_volume(folder / VOLUME, measured.volume, geometry.dVoxel, first_voxel(geometry), 'density per mm')
        if settings.cloud:
            write_ply(folder / CLOUD, *fitted.world_gaussians(), fitted.shares())
        write_scene(folder / SCENE, fitted.corrected, settings.model.extent if settings.cloud else None, fitted.effects)
    if measured.views is not None:
        _write_views(folder, measured.views)
    numbers = measured.numbers | dict(
        method=method,
        seed=fitted.seed,
        views=len(geometry),
        variant=mi.variant(),
        settings=fitted.settings.flat(),
        initial=fitted.info,
        command=command,
        **_corrections(fitted),
        angles=np.degrees(geometry.angles).tolist(),
        pixel=list(geometry.dDetector),
        test_angles=[] if measured.test is None else np.degrees(measured.test.geometry.angles).tolist(),
        versions=versions(),
        **({} if request is None else dict(request=request)),
    )
    try:
        write_report(folder, report_data(fitted, replace(measured, numbers=numbers), title))
    except InputError:  # the disk is full, and the like
        raise
    except Exception as error:  # of the libraries that draw: the numbers are worth more than their picture
        warnings.warn(
            f'{folder}: the report could not be drawn ({brief(error, 150)}); all else is written', stacklevel=2
        )
        names -= {PICTURE, PAGE}
        remove_others(folder, names)
    return complete(folder, names - {METRICS}, numbers, default=np.generic.item)


def result_names(settings: Settings, views: int) -> frozenset[str]:
    """The files that `save` writes of a fit with these settings and so many held-out views."""
    names = {PICTURE, PAGE, METRICS, *map(view_name, range(views))}
    return frozenset(
        names | ({CLOUD} if settings.cloud else set()) | ({VOLUME, SCENE} if settings.volumetric else set())
    )


def report_data(fitted: Fitted, measured: Measured, title: str) -> ReportData:
    """The contents of a measured fit's report."""
    geometry, test = fitted.geometry, measured.test
    more: dict = {}
    if test is not None:
        angles = np.degrees(test.geometry.angles)
        views = None if measured.views is None else comparable(measured.views, test)
        more = dict(views=views, views_truth=test.projections, views_angles=angles)
    if fitted.settings.cloud:
        centres, scales, quaternions, density = fitted.world_gaussians()
        more |= dict(cloud_centres=centres, cloud_density=density, cloud_scales=scales, cloud_quaternions=quaternions)
    return ReportData(
        title=title,
        metrics=measured.numbers if fitted.settings.cloud else _without_gaussians(measured.numbers),
        volume=measured.volume,
        truth=None if measured.volume is None else measured.truth,
        shape=geometry.nVoxel,
        spacing=geometry.dVoxel,
        centre=geometry.offOrigin,
        pixel=geometry.dDetector,
        scanner=fitted.corrected,
        cloud_unit='opacity' if measured.volume is None else 'density at the centre [1/mm]',
        command=measured.numbers.get('command', ''),
        **more,
    )


def _write_views(folder: Path, rendered: np.ndarray):
    """Write one image per view."""
    with writing(folder):
        (folder / VIEWS).mkdir(exist_ok=True)
    for i, image in enumerate(rendered):
        write_exr(folder / view_name(i), image)


def _without_gaussians(numbers: dict) -> dict:
    """Numbers of a neural field without those that only a cloud has, as a report shows them."""
    of_clouds = {'ipsd', 'ipsd_targets', 'ipsd_reverse', 'gaussians'}
    history = [{k: v for k, v in entry.items() if k not in of_clouds} for entry in numbers['history']]
    return {k: v for k, v in numbers.items() if k not in of_clouds} | dict(history=history)


def _corrections(fitted: Fitted) -> dict:
    """What the fit has found of the measurement's errors: the response (levels, per cent), and corrections of the views' poses,
    rotation vectors and shifts about the volume's centre."""
    poses, response = fitted.poses, fitted.model.response
    found = {} if response is None else dict(response=response.report())
    if poses is None:
        return found
    return found | dict(
        pose_turns_degrees=np.degrees(poses.turn).tolist(),
        pose_shifts_mm=(poses.shift / fitted.geometry.scale).tolist(),
    )


def versions() -> dict:
    """Versions of the software that computed a result."""
    return dict(
        python=platform.python_version(),
        **{name: version(name) for name in ('lingo_mi', 'mitsuba', 'drjit', 'numpy', 'scipy', 'scikit-image')},
        date=time.strftime('%Y-%m-%d'),
    )
