"""What a fit leaves behind: volume, cloud, scene, views, measurements, report."""

from __future__ import annotations

import json
import platform
import time
from importlib.metadata import version
from pathlib import Path

import mitsuba as mi
import numpy as np

from lingo_mi.files.images import write_exr
from lingo_mi.files.ply import write_ply, write_radiance_ply
from lingo_mi.files.volumes import first_voxel, write_volume
from lingo_mi.fit.checkpoint import METRICS
from lingo_mi.fit.fitted import Fitted
from lingo_mi.fit.models.alpha import harmonics
from lingo_mi.fit.state import activate
from lingo_mi.report.page import ReportData, write_report
from lingo_mi.results.measure import measure
from lingo_mi.results.scene_file import write_scene
from lingo_mi.scan import Dataset


def world_cloud(fitted: Fitted, geometry):
    """Centres [N, 3] and standard deviations [N, 3] in mm, quaternions (x, y, z, w) and densities or opacities [N]."""
    centre, scale, rotation, amount = activate(fitted.state, fitted.settings)
    unit = fitted.unit if fitted.settings.volumetric else 1
    return centre / geometry.scale + geometry.offOrigin, scale / geometry.scale, rotation, amount * unit


def write_results(
    folder: Path, fitted: Fitted, dataset: Dataset, *, title: str, method: str, seed: int, command: str
) -> dict:
    """Write everything into `folder` and return the metrics: `volume.nii.gz`, `gaussians.ply`, `result.xml`, `views/`,
    `metrics.json`, `report.png`, `report.html`. metrics.json is written last, so that it tells a complete result.

    A fit by alpha compositing has no volume, and no integrator renders a scene of its cloud: it leaves neither.
    """
    geometry, test = dataset.train.geometry, dataset.test
    volume = fitted.volume()
    cloud = world_cloud(fitted, geometry)
    if volume is None:
        for stale in 'volume.nii.gz', 'result.xml':
            (folder / stale).unlink(missing_ok=True)
        write_radiance_ply(folder / 'gaussians.ply', *cloud, *harmonics(fitted.state.values))
    else:
        write_volume(folder / 'volume.nii.gz', volume, geometry.dVoxel, first_voxel(geometry), 'density per mm')
        write_ply(folder / 'gaussians.ply', *cloud, fitted.shares())
        write_scene(folder / 'result.xml', fitted.corrected, fitted.settings.model.extent, fitted.effects)
    rendered = None
    if test is not None and len(test):
        rendered = fitted.render(test.geometry)
        views = folder / 'views'
        views.mkdir(exist_ok=True)
        for stale in views.glob('*.exr'):
            stale.unlink()
        for i, image in enumerate(rendered):
            write_exr(views / f'{i:04d}.exr', image)
    measured = measure(fitted, dataset, volume, rendered) | dict(
        method=method,
        seed=seed,
        views=len(dataset.train),
        variant=mi.variant(),
        settings=fitted.settings.flat(),
        initial=fitted.info,
        command=command,
        **_corrections(fitted),
        angles=_degrees(geometry),
        test_angles=_degrees(test.geometry) if rendered is not None else [],
        versions=versions(),
    )
    report = ReportData(
        title=title,
        metrics=measured,
        volume=volume,
        truth=None if volume is None else dataset.volume,
        shape=geometry.nVoxel,
        spacing=geometry.dVoxel,
        centre=geometry.offOrigin,
        views=rendered,
        views_truth=test.projections if rendered is not None else None,
        views_angles=np.degrees(test.geometry.angles) if rendered is not None else None,
        pixel=geometry.dDetector,
        cloud_centres=cloud[0],
        cloud_density=cloud[3],
        cloud_unit='opacity' if volume is None else 'density at the centre [1/mm]',
        command=command,
    )
    write_report(folder, report)
    temporary = folder / (METRICS + '.partial')
    temporary.write_text(json.dumps(measured, indent=1, default=np.generic.item) + '\n', encoding='utf-8')
    temporary.replace(folder / METRICS)
    return measured


def _corrections(fitted) -> dict:
    """How the fit moved the views about the volume's centre, if it did: rotation vectors and shifts of every view."""
    poses = fitted.poses
    return (
        {}
        if poses is None
        else dict(
            pose_turns_degrees=np.degrees(poses.turn).tolist(),
            pose_shifts_mm=(poses.shift / fitted.geometry.scale).tolist(),
        )
    )


def versions() -> dict:
    """Versions of what computed a result."""
    return dict(
        python=platform.python_version(),
        **{name: version(name) for name in ('lingo_mi', 'mitsuba', 'drjit', 'numpy', 'scipy', 'scikit-image')},
        date=time.strftime('%Y-%m-%d'),
    )


def _degrees(geometry) -> list[float]:
    return np.degrees(geometry.angles).tolist()
