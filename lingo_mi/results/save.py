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
from lingo_mi.report.page import ReportData, write_report
from lingo_mi.results.measure import measure
from lingo_mi.results.scene_file import write_scene
from lingo_mi.scan import Scan


def save(
    folder: Path,
    fitted: Fitted,
    test: Scan | None = None,
    truth: np.ndarray | None = None,
    title: str = 'fit',
    method: str = '',
    command: str = '',
) -> dict:
    """Write everything into `folder` and return the metrics: `volume.nii.gz`, `gaussians.ply`, `result.xml`, `views/`,
    `metrics.json`, `report.png`, `report.html`. metrics.json is written last, so that it tells a complete result.

    folder    which is there already
    test      held-out views to compare with
    truth     the true density in 1/mm on the grid of the fit's geometry, [x, y, z]
    title     of the report
    method    name of the recipe, and command: what makes the result again; both for metrics.json and the report

    A fit by alpha compositing has no volume, and no integrator renders a scene of its cloud: it leaves neither.
    Raises InputError where a file cannot be written.
    """
    geometry, test = fitted.geometry, test if test is not None and len(test) else None
    volume, cloud = fitted.volume(), fitted.world_gaussians()
    if volume is None:
        for stale in 'volume.nii.gz', 'result.xml':
            (folder / stale).unlink(missing_ok=True)
        write_radiance_ply(folder / 'gaussians.ply', *cloud, *harmonics(fitted.state.values))
    else:
        write_volume(folder / 'volume.nii.gz', volume, geometry.dVoxel, first_voxel(geometry), 'density per mm')
        write_ply(folder / 'gaussians.ply', *cloud, fitted.shares())
        write_scene(folder / 'result.xml', fitted.corrected, fitted.settings.model.extent, fitted.effects)
    rendered = None if test is None else fitted.render(test.geometry)
    if rendered is not None:
        _write_views(folder / 'views', rendered)
    measured = measure(fitted, volume, truth, rendered, test) | dict(
        method=method,
        seed=fitted.seed,
        views=len(geometry),
        variant=mi.variant(),
        settings=fitted.settings.flat(),
        initial=fitted.info,
        command=command,
        **_corrections(fitted),
        angles=np.degrees(geometry.angles).tolist(),
        test_angles=[] if test is None else np.degrees(test.geometry.angles).tolist(),
        versions=versions(),
    )
    report = ReportData(
        title=title,
        metrics=measured,
        volume=volume,
        truth=None if volume is None else truth,
        shape=geometry.nVoxel,
        spacing=geometry.dVoxel,
        centre=geometry.offOrigin,
        views=rendered,
        views_truth=None if test is None else test.projections,
        views_angles=None if test is None else np.degrees(test.geometry.angles),
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


def _write_views(folder: Path, rendered: np.ndarray):
    """One image a view, in place of those of an earlier result."""
    folder.mkdir(exist_ok=True)
    for stale in folder.glob('*.exr'):
        stale.unlink()
    for i, image in enumerate(rendered):
        write_exr(folder / f'{i:04d}.exr', image)


def _corrections(fitted: Fitted) -> dict:
    """How the fit moved the views about the volume's centre, if it did: rotation vectors and shifts of every view."""
    poses = fitted.poses
    if poses is None:
        return {}
    return dict(
        pose_turns_degrees=np.degrees(poses.turn).tolist(),
        pose_shifts_mm=(poses.shift / fitted.geometry.scale).tolist(),
    )


def versions() -> dict:
    """Versions of what computed a result."""
    return dict(
        python=platform.python_version(),
        **{name: version(name) for name in ('lingo_mi', 'mitsuba', 'drjit', 'numpy', 'scipy', 'scikit-image')},
        date=time.strftime('%Y-%m-%d'),
    )
