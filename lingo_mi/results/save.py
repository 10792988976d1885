"""The files of a fit: volume, cloud, scene, views, measurements, report."""

from __future__ import annotations

import json
import platform
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import mitsuba as mi
import numpy as np

from lingo_mi.file_access import replacing
from lingo_mi.files.images import write_exr
from lingo_mi.files.ply import write_ply, write_radiance_ply
from lingo_mi.files.volumes import first_voxel, write_volume
from lingo_mi.fitting.checkpoint import METRICS
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.models.alpha import harmonics
from lingo_mi.report.page import ReportData, write_report
from lingo_mi.results.measure import Measured
from lingo_mi.results.scene_file import write_scene


def save(
    folder: Path, fitted: Fitted, measured: Measured, *, title: str = 'fit', method: str = '', command: str = ''
) -> dict:
    """Write all files into `folder` and return the metrics: `volume.nii.gz`, `gaussians.ply`, `result.xml`, `views/`,
    `metrics.json`, `report.png`, `report.html`. metrics.json is written last, so that it marks a complete result.

    folder     an existing folder
    measured   the measured fit
    title      of the report
    method     the recipe's name, for metrics.json and the report
    command    the command line that reproduces the result, for the same

    For alpha compositing there is no volume, and no scene, because no integrator renders it.
    Raises InputError if a file cannot be written.
    """
    geometry, cloud = fitted.geometry, fitted.world_gaussians()
    if measured.volume is None:
        for stale in 'volume.nii.gz', 'result.xml':
            (folder / stale).unlink(missing_ok=True)
        write_radiance_ply(folder / 'gaussians.ply', *cloud, *harmonics(fitted.state.values))
    else:
        write_volume(
            folder / 'volume.nii.gz', measured.volume, geometry.dVoxel, first_voxel(geometry), 'density per mm'
        )
        write_ply(folder / 'gaussians.ply', *cloud, fitted.shares())
        write_scene(folder / 'result.xml', fitted.corrected, fitted.settings.model.extent, fitted.effects)
    if measured.views is not None:
        _write_views(folder / 'views', measured.views)
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
        test_angles=[] if measured.test is None else np.degrees(measured.test.geometry.angles).tolist(),
        versions=versions(),
    )
    write_report(folder, report_data(fitted, replace(measured, numbers=numbers), title))
    with replacing(folder / METRICS) as temporary:
        temporary.write_text(json.dumps(numbers, indent=1, default=np.generic.item) + '\n', encoding='utf-8')
    return numbers


def report_data(fitted: Fitted, measured: Measured, title: str) -> ReportData:
    """The contents of a measured fit's report."""
    geometry, test = fitted.geometry, measured.test
    held_out = {}
    if test is not None:
        angles = np.degrees(test.geometry.angles)
        held_out = dict(views=measured.views, views_truth=test.projections, views_angles=angles)
    centres, _, _, density = fitted.world_gaussians()
    return ReportData(
        title=title,
        metrics=measured.numbers,
        volume=measured.volume,
        truth=None if measured.volume is None else measured.truth,
        shape=geometry.nVoxel,
        spacing=geometry.dVoxel,
        centre=geometry.offOrigin,
        pixel=geometry.dDetector,
        cloud_centres=centres,
        cloud_density=density,
        cloud_unit='opacity' if measured.volume is None else 'density at the centre [1/mm]',
        command=measured.numbers.get('command', ''),
        **held_out,
    )


def _write_views(folder: Path, rendered: np.ndarray):
    """Write one image per view; those of an earlier result are removed."""
    folder.mkdir(exist_ok=True)
    for stale in folder.glob('*.exr'):
        stale.unlink()
    for i, image in enumerate(rendered):
        write_exr(folder / f'{i:04d}.exr', image)


def _corrections(fitted: Fitted) -> dict:
    """Corrections of the views' poses, if the fit has any: rotation vectors and shifts about the volume's centre."""
    poses = fitted.poses
    if poses is None:
        return {}
    return dict(
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
