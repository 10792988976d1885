"""The two-stage way: views that were not measured are rendered from a fitted cloud, then a volume is made of all of them."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from lingo_mi.effects.forward import Effects, find_effects
from lingo_mi.errors import InputError
from lingo_mi.fit import checkpoint
from lingo_mi.fit.checkpoint import METRICS
from lingo_mi.fit.device import DeviceState
from lingo_mi.fit.poses import Poses
from lingo_mi.fit.settings import Settings
from lingo_mi.fit.state import State
from lingo_mi.fit.step import Stepper
from lingo_mi.geometry.base import Geometry, spread
from lingo_mi.projectors.objects import Ellipsoids, find_objects
from lingo_mi.reconstruction.effects_correction import corrected
from lingo_mi.reconstruction.views import gaps, require_circle
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.checks import check_memory
from lingo_mi.scene.description import MOST_VIEWS
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import render_objects

WANTED = 'give the result.xml of a fit, or the checkpoint.npz of one by 3dgs or xgaussian'


@dataclass(frozen=True)
class FittedCloud:
    """A cloud of Gaussians as a fit left it.

    gaussians   densities in 1/mm
    geometry    of the scan that it was fitted to
    corrected   the same with its views where the fit has put them: `geometry` itself, where it left them alone
    extent      cut-off in standard deviations
    effects     that the fit has modelled; None where it took the projections for line integrals
    seed        of the fit, and of the noise that it has seen in a simulated scan; None where that is not known
    """

    gaussians: Ellipsoids
    geometry: Geometry
    corrected: Geometry
    extent: float
    effects: Effects | None
    seed: int | None

    def render(self, geometry: Geometry) -> np.ndarray:
        """Line integrals in any views, float32 [view, v, u]."""
        return render_objects([self.gaussians], geometry, self.extent)


@dataclass(frozen=True)
class CompositedCloud:
    """A cloud as a fit by alpha compositing left it, which no scene renders.

    state, settings       of the fit
    geometry, corrected   as of a `FittedCloud`
    unit                  what the fit counts as 1 (`fit.step.density_unit`)
    seed                  of the fit
    """

    state: State
    settings: Settings
    geometry: Geometry
    corrected: Geometry
    unit: float
    seed: int
    effects = None

    def render(self, geometry: Geometry) -> np.ndarray:
        """Composited images, taken for line integrals, in any views, float32 [view, v, u]."""
        blank = Scan(geometry.subset([0]), np.zeros((1, *geometry.nDetector)))
        return Stepper(blank, self.settings, self.unit).render(DeviceState(self.state), geometry)


def load_cloud(path) -> FittedCloud | CompositedCloud:
    """The cloud of a scene such as a fit's result.xml, or of the checkpoint (.npz) of a fit by alpha compositing.

    Raises InputError where there is anything else.
    """
    if Path(path).suffix == '.npz':
        return _composited(path)
    loaded = load_scene(Path(path))
    objects = find_objects(loaded.scene)
    options = getattr(loaded.scene.integrator(), 'options', None)
    if options is None or len(objects) != 1 or not isinstance(objects[0], Ellipsoids):
        raise InputError(f'{path}: is no cloud of Gaussians; {WANTED}')
    corrected, record = loaded.scanner.geometry, _record(path)
    return FittedCloud(
        objects[0],
        _as_given(corrected, record, path),
        corrected,
        options.extent,
        find_effects(loaded.scene, loaded.scanner),
        record.get('seed'),
    )


def _record(path) -> dict:
    """What the fit has noted beside its result.xml; nothing where there is no such file."""
    file = Path(path).with_name(METRICS)
    if not file.exists():
        return {}
    try:
        record = json.loads(file.read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise InputError(f'{file}: cannot be read ({type(error).__name__}); fit again, or remove it') from None
    return record if isinstance(record, dict) else {}


def _as_given(geometry: Geometry, record: dict, path) -> Geometry:
    """The geometry that the fit was given, from the corrected one of its result.xml."""
    if 'pose_turns_degrees' not in record:
        return geometry
    poses = Poses(len(geometry))
    try:
        turn, shift = (np.array(record[name], float) for name in ('pose_turns_degrees', 'pose_shifts_mm'))
    except (KeyError, TypeError, ValueError):
        turn = shift = np.empty(0)
    if turn.shape != poses.turn.shape or shift.shape != poses.shift.shape:
        raise InputError(f'{path}: the poses in the {METRICS} beside it are of another fit')
    poses.turn, poses.shift = np.radians(turn), shift * geometry.scale
    return poses.undone().corrected(geometry)


def _composited(path):
    if not Path(path).exists():
        raise InputError(f'{path}: no such file; {WANTED}')
    state, extra, arrays = checkpoint.load(path)
    try:
        if extra['settings']['render'] != 'alpha':
            raise InputError(f'{path}: is no checkpoint of a fit by alpha compositing; {WANTED}')
        settings = Settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in extra['settings'].items()})
        scanner, unit, seed = (extra[name] for name in ('scanner', 'unit', 'seed'))
    except (KeyError, TypeError):
        raise InputError(f'{path}: is no checkpoint of a fit by this version of lingo_mi; {WANTED}') from None
    geometry = corrected = mi.load_dict(scanner).geometry
    if max(settings.rate_pose) > 0:
        poses = Poses(len(geometry))
        poses.restore(arrays)
        corrected = poses.corrected(geometry)
    return CompositedCloud(state, settings, geometry, corrected, unit, seed)


def fitted_views(dataset: Dataset, geometry: Geometry) -> Scan:
    """The measured views of a data set whose rays are those of `geometry`, in its order, to a hundredth of a pixel.

    Angles do not tell views: a helix comes back to them at other heights. Where views repeat each other, they are those that
    fit.py chooses, else the first of them that are left. Raises InputError where a view is missing.
    """
    scan = dataset.train
    reach = np.linalg.norm(scan.geometry.rays().corner, axis=1).max()
    there, wanted = _corners(scan.geometry, reach), _corners(geometry, reach)
    allowed = 0.01 * min(scan.geometry.dDetector)
    missing = InputError(
        f'the cloud was fitted to {len(geometry)} views, not all of which are among the '
        f'{len(scan)} of this scan: give the scan that it was fitted to'
    )
    if len(scan) < len(geometry) or scan.geometry.mode != geometry.mode:
        raise missing
    chosen = spread(len(scan), len(geometry))
    if np.abs(there[chosen] - wanted).max() > allowed:
        left = np.ones(len(scan), bool)
        for i, view in enumerate(wanted):
            same = left & (np.abs(there - view).max(1) <= allowed)
            if not same.any():
                raise missing
            chosen[i] = np.argmax(same)
            left[chosen[i]] = False
    return scan.subset(chosen)


def _corners(geometry: Geometry, reach: float) -> np.ndarray:
    """What tells views apart, [view, 12] in mm: the source, or how far a beam goes sideways in `reach`, and three corners of
    the panel."""
    f, (rows, columns) = geometry.rays(), geometry.nDetector
    source = f.source * reach if f.parallel else f.source
    return np.concatenate([source, f.corner, f.corner + columns * f.u, f.corner + rows * f.v], 1)


def as_corrected(scan: Scan, cloud: FittedCloud | CompositedCloud) -> Scan:
    """The `fitted_views` with their poses as the fit has corrected them; as they are, where it left them alone."""
    if cloud.corrected is cloud.geometry:
        return scan
    g = scan.geometry
    return replace(scan, geometry=replace(cloud.corrected, nVoxel=g.nVoxel, dVoxel=g.dVoxel, offOrigin=g.offOrigin))


def missing_angles(angles, views: int, geometry: Geometry) -> np.ndarray:
    """Angles (radians) of the views - len(angles) views that spread `views` as evenly as the given ones allow.

    The widest step is divided first, until there are enough views; an arc that is open stays as long as it is.
    """
    order, gap, is_open = gaps(replace(geometry, angles=angles), 2 * np.pi)
    parts = np.ones(len(gap), int)
    for _ in range(views - len(angles)):
        parts[np.argmax(gap / parts - 1e-9 * np.arange(len(gap)))] += 1
    return np.concatenate([angles[i] + g * np.arange(1, k) / k for i, g, k in zip(order, gap, parts)])


def without_effects(scan: Scan, cloud: FittedCloud | CompositedCloud) -> Scan:
    """The line integrals of measured views, `corrected` by the cloud for the effects that its fit has modelled; where it has
    modelled none, the projections themselves."""
    return scan if cloud.effects is None else corrected(scan, cloud.effects, [cloud.gaussians], cloud.extent)


def complete(scan: Scan, cloud: FittedCloud | CompositedCloud, views: int) -> Scan:
    """A scan of `views` views: the measured ones, `as_corrected` and `without_effects`, and those between them rendered from
    the cloud.

    Raises InputError where fewer views are asked for than were measured or more than a scan may have, and for a scan that is
    no circle about z.
    """
    require_circle(scan, 'the completion of a scan')
    if views > MOST_VIEWS:
        raise InputError(f'{views} views were asked for, but a scan has at most {MOST_VIEWS}')
    check_memory(scan.geometry, views=views)
    return filled(without_effects(as_corrected(scan, cloud), cloud), views, cloud.render, scan.geometry)


def filled(scan: Scan, views: int, render, circle: Geometry | None = None) -> Scan:
    """A scan of `views` views: the given ones and those between them, by `render`, a function of their geometry.

    circle   where the views should be, if a fit has found them to be beside it (default: where they are)

    Raises InputError where fewer views are asked for than are given.
    """
    geometry = circle or scan.geometry
    if views < len(scan):
        raise InputError(f'{views} views were asked for, but {len(scan)} are measured: ask for more')
    if views == len(scan):
        return scan
    rendered = replace(geometry, angles=missing_angles(geometry.angles, views, geometry))
    return Scan(scan.geometry.joined(rendered), np.concatenate([scan.projections, render(rendered)]))
