"""What a fit leaves behind: volume, cloud, scene, views, measurements, report."""
from __future__ import annotations

import json
import platform
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from xml.sax.saxutils import quoteattr

import mitsuba as mi
import numpy as np

from . import metrics
from .effects.detector import Detector
from .files.images import write_exr
from .files.ply import write_ply, write_radiance_ply
from .files.volumes import first_voxel, write_volume
from .fit.device import DeviceState
from .fit.loop import Fitted
from .fit.state import activate, harmonics
from .lingo.ipsd import ipsd, reverse_distance
from .report import ReportData, write_report
from .scan import Dataset

METRICS, CHECKPOINT = 'metrics.json', 'checkpoint.npz'


def quick_measure(dataset: Dataset, most: int = 4):
    """A function for `fit.loop.run` that gives 2D PSNR on a few held-out views and 3D PSNR where the truth is known."""
    test = dataset.test
    if test is not None and len(test) > most:
        test = test.subset(np.arange(most) * len(test) // most)

    def measure(stepper, state):
        out = {}
        if test is not None and len(test):
            rendered = _comparable(stepper.render(state, test.geometry), test)
            out['psnr_2d'] = _number(metrics.psnr_2d(rendered, test.projections))
        if dataset.volume is not None and (volume := stepper.volume(state)) is not None:
            out['psnr_3d'] = _number(metrics.psnr_3d(volume, dataset.volume))
        return out
    return measure


def _comparable(rendered, test):
    """Rendered views with the pixels that were not measured at zero, as in the scan."""
    return rendered if test.valid is None else np.where(test.valid, rendered, np.float32(0))


def world_cloud(fitted: Fitted, geometry):
    """Centres [N, 3] and standard deviations [N, 3] in mm, quaternions (x, y, z, w) and densities or opacities [N]."""
    centre, scale, rotation, amount = activate(fitted.state, fitted.settings)
    unit = fitted.stepper.unit if fitted.settings.render == 'integral' else 1
    return centre / geometry.scale + geometry.offOrigin, scale / geometry.scale, rotation, amount * unit


def write_results(folder: Path, fitted: Fitted, dataset: Dataset, *, title: str, method: str, seed: int,
                  command: str) -> dict:
    """Write everything into `folder` and return the metrics: `volume.nii.gz`, `gaussians.ply`, `result.xml`, `views/`,
    `metrics.json`, `report.png`, `report.html`. metrics.json is written last, so that it tells a complete result.

    A fit by alpha compositing has no volume, and no integrator renders a scene of its cloud: it leaves neither.
    """
    geometry, test = dataset.train.geometry, dataset.test
    state = DeviceState(fitted.state)
    volume = fitted.stepper.volume(state)
    cloud = world_cloud(fitted, geometry)
    if volume is None:
        for stale in 'volume.nii.gz', 'result.xml':
            (folder / stale).unlink(missing_ok=True)
        write_radiance_ply(folder / 'gaussians.ply', *cloud, *harmonics(fitted.state))
    else:
        write_volume(folder / 'volume.nii.gz', volume, geometry.dVoxel, first_voxel(geometry), 'density per mm')
        share = fitted.stepper.shares(state)
        write_ply(folder / 'gaussians.ply', *cloud, None if share is None else share.numpy())
        effects = dataset.train.effects if fitted.stepper.model is not None else None
        write_scene(folder / 'result.xml', fitted.stepper.corrected(), fitted.settings.extent, effects)
    rendered = None
    if test is not None and len(test):
        rendered = fitted.stepper.render(state, test.geometry)
        views = folder / 'views'
        views.mkdir(exist_ok=True)
        for stale in views.glob('*.exr'):
            stale.unlink()
        for i, image in enumerate(rendered):
            write_exr(views / f'{i:04d}.exr', image)
    measured = measure(fitted, dataset, volume, rendered) | dict(
        method=method, seed=seed, views=len(dataset.train), variant=mi.variant(), settings=asdict(fitted.settings),
        initial=fitted.info, command=command, **_corrections(fitted),
        angles=_degrees(geometry), test_angles=_degrees(test.geometry) if rendered is not None else [],
        versions=versions())
    report = ReportData(
        title=title, metrics=measured, volume=volume, truth=None if volume is None else dataset.volume,
        shape=geometry.nVoxel, spacing=geometry.dVoxel,
        centre=geometry.offOrigin, views=rendered, views_truth=test.projections if rendered is not None else None,
        views_angles=np.degrees(test.geometry.angles) if rendered is not None else None, pixel=geometry.dDetector,
        cloud_centres=cloud[0], cloud_density=cloud[3],
        cloud_unit='opacity' if volume is None else 'density at the centre [1/mm]', command=command)
    write_report(folder, report)
    temporary = folder / (METRICS + '.partial')
    temporary.write_text(json.dumps(measured, indent=1, default=np.generic.item) + '\n', encoding='utf-8')
    temporary.replace(folder / METRICS)
    return measured


def measure(fitted: Fitted, dataset: Dataset, volume, rendered) -> dict:
    """The numbers of a finished fit; None where there is no truth to compare with."""
    born = fitted.state.values['centre'][fitted.state.born]
    test = dataset.test
    truth = test.projections if rendered is not None else None
    rendered = None if rendered is None else _comparable(rendered, test)

    def of(function, result, reference):
        return None if result is None or reference is None else _number(function(result, reference))
    return dict(
        psnr_2d_r2=of(metrics.psnr_2d_r2, rendered, truth), psnr_2d=of(metrics.psnr_2d, rendered, truth),
        ssim_2d=of(metrics.ssim_2d, rendered, truth), **compared(volume, dataset.volume),
        ipsd=_number(ipsd(fitted.initial, born)), ipsd_targets=len(born),
        ipsd_reverse=_number(reverse_distance(fitted.initial, born)),
        gaussians=len(fitted.state), iterations=fitted.settings.iterations,
        seconds_init=fitted.info['seconds'], seconds_fit=fitted.seconds,
        ms_per_iteration=1e3 * fitted.seconds / fitted.settings.iterations, history=fitted.history)


def _corrections(fitted) -> dict:
    """How the fit moved the views about the volume's centre, if it did: rotation vectors and shifts of every view."""
    poses = fitted.stepper.poses
    return {} if poses is None else dict(pose_turns_degrees=np.degrees(poses.turn).tolist(),
                                         pose_shifts_mm=(poses.shift / fitted.stepper.geometry.scale).tolist())


def write_scene(path: Path, geometry, extent: float, effects=None):
    """A scene that renders the fitted cloud with the scan's own scanner; needs only `import lingo_mi`.

    effects   of the scan that the fit has modelled: the scene then has their tube, and a detector without noise, so that it
              renders what the fit compared with the scan
    """
    from .plugins.ct_scanner import describe
    lines = ['<scene version="3.0.0">', '    <integrator type="lingo_xray">',
             f'        <float name="extent" value="{extent:g}"/>', '    </integrator>',
             '    <shape type="ellipsoids" id="cloud">', '        <string name="filename" value="gaussians.ply"/>',
             '    </shape>', '    <sensor type="ct_scanner" id="scanner">']
    lines += _parameters(describe(geometry), 8)
    if effects is not None and effects.detector:
        given = {k: v for k, v in vars(effects.detector.expected).items() if v != Detector.DEFAULTS[k]}
        lines += ['        <film type="ct_detector">', *_parameters(given, 12), '        </film>']
    lines += ['    </sensor>']
    if effects is not None and effects.tube:
        spot = dict(focal_spot='{:g}, {:g}'.format(*effects.spot.size), focal_order=effects.spot.order)
        given = {k: v for k, v in effects.tube.given.items() if not (v is None or v == '' or k.startswith('material'))}
        if effects.tube.hardens or effects.scatter:  # the cloud stands for all shapes
            given['material'] = ' + '.join(effects.tube.fitted())
        scatter = effects.scatter.within(geometry).given if effects.scatter else {}
        lines += ['    <emitter type="xray_tube" id="tube">', *_parameters(given | spot | scatter, 8), '    </emitter>']
    path.write_text('\n'.join([*lines, '</scene>']) + '\n', encoding='utf-8')


def _parameters(values: dict, indent: int) -> list[str]:
    """Parameters of a plugin as lines of XML."""
    kinds = {str: 'string', float: 'float', int: 'integer'}
    return [' ' * indent + f'<{kinds[type(v)]} name="{k}" value={quoteattr(v if isinstance(v, str) else repr(v))}/>'
            for k, v in values.items() if k != 'type']


def versions() -> dict:
    """Versions of what computed a result."""
    return dict(python=platform.python_version(),
                **{name: version(name) for name in ('lingo_mi', 'mitsuba', 'drjit', 'numpy', 'scipy', 'scikit-image')},
                date=time.strftime('%Y-%m-%d'))


def _degrees(geometry) -> list[float]:
    return np.degrees(geometry.angles).tolist()


def _number(x: float):
    """A number for JSON, which has neither NaN nor infinity, or None."""
    return x if np.isfinite(x) else None


def compared(volume, truth) -> dict:
    """PSNR and SSIM of a volume, in both of their forms; None where there is nothing to compare, or no number."""
    names = 'psnr_3d', 'ssim_3d', 'psnr_3d_absolute', 'ssim_3d_absolute'
    if volume is None or truth is None:
        return dict.fromkeys(names)
    return {name: _number(getattr(metrics, name)(volume, truth)) for name in names}


def volume_quality(result: dict) -> str:
    """The lines of a volume's numbers (`compared`): for densities in any unit first, then R2-Gaussian's, for those up to 1."""
    return (f'volume          {_shown(result, "psnr_3d_absolute", "ssim_3d_absolute")} (full scale: the largest true density)\n'
            f'                {_shown(result, "psnr_3d", "ssim_3d")} (full scale: 1, as in R2-Gaussian)')


def _shown(result: dict, psnr: str, ssim: str) -> str:
    psnr, ssim = ('n/a' if result[name] is None else form.format(result[name])
                  for name, form in ((psnr, '{:.2f} dB'), (ssim, '{:.4f}')))
    return f'PSNR {psnr}, SSIM {ssim}'


def summary(result: dict) -> str:
    """The main numbers of a result, one line each."""
    return '\n'.join([
        f'held-out views  {_shown(result, "psnr_2d", "ssim_2d")}',
        volume_quality(result),
        f'cloud           {result["gaussians"]:,} Gaussians after {result["iterations"]} iterations of '
        f'{result["ms_per_iteration"]:.0f} ms: {result["seconds_init"]:.1f} s to start, '
        f'{result["seconds_fit"]:.0f} s to fit'])
