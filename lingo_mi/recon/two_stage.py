"""The two-stage way: views that were not measured are rendered from a fitted cloud, then a volume is made of all of them."""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..effects.forward import Effects, find_effects
from ..errors import InputError
from ..fit import checkpoint
from ..fit.device import DeviceState
from ..fit.settings import Settings
from ..fit.state import State
from ..fit.step import Stepper
from ..geometry import Geometry
from ..scan import Dataset, Scan
from ..scanning import load_scene, render_objects
from ..xray.objects import Ellipsoids, find_objects
from .circle import require_circle
from .corrections import corrected
from .fdk import gaps

WANTED = 'give the result.xml of a fit, or the checkpoint.npz of one by 3dgs or xgaussian'


@dataclass(frozen=True)
class FittedCloud:
    """A cloud of Gaussians as a fit left it.

    gaussians   densities in 1/mm
    geometry    of the scan that it was fitted to
    extent      cut-off in standard deviations
    effects     that the fit has modelled; None where it took the projections for line integrals
    """

    gaussians: Ellipsoids
    geometry: Geometry
    extent: float
    effects: Effects | None

    def render(self, geometry: Geometry) -> np.ndarray:
        """Line integrals in any views, float32 [view, v, u]."""
        return render_objects([self.gaussians], geometry, self.extent)


@dataclass(frozen=True)
class CompositedCloud:
    """A cloud as a fit by alpha compositing left it, which no scene renders.

    state, settings   of the fit
    geometry          of the scan that it was fitted to
    unit              what the fit counts as 1 (`fit.step.density_unit`)
    """

    state: State
    settings: Settings
    geometry: Geometry
    unit: float
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
    quality = getattr(loaded.scene.integrator(), 'quality', None)
    if quality is None or len(objects) != 1 or not isinstance(objects[0], Ellipsoids):
        raise InputError(f'{path}: is no cloud of Gaussians; {WANTED}')
    return FittedCloud(objects[0], loaded.scanner.geometry, quality.extent, find_effects(loaded.scene, loaded.scanner))


def _composited(path):
    if not Path(path).exists():
        raise InputError(f'{path}: no such file; {WANTED}')
    state, extra, _ = checkpoint.load(path)
    if extra.get('settings', {}).get('render') != 'alpha':
        raise InputError(f'{path}: is no checkpoint of a fit by alpha compositing; {WANTED}')
    settings = Settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in extra['settings'].items()})
    return CompositedCloud(state, settings, mi.load_dict(extra['scanner']).geometry, extra['unit'])


def fitted_views(dataset: Dataset, geometry: Geometry) -> Scan:
    """The measured views of a data set at the angles of `geometry`, to 1e-5 radians.

    Raises InputError where one of them is missing.
    """
    turn = np.exp(1j * dataset.train.geometry.angles)
    distance = np.abs(np.exp(1j * geometry.angles)[:, None] - turn)
    if len(dataset.train) < len(geometry) or distance.min(1).max() > 1e-5:
        raise InputError(f'the cloud was fitted to {len(geometry)} views, not all of which are among the '
                         f'{len(dataset.train)} of this scan: give the scan that it was fitted to')
    return dataset.train.subset(np.sort(distance.argmin(1)))


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
    """A scan of `views` views: the measured ones, `without_effects`, and those between them rendered from the cloud.

    Raises InputError where fewer views are asked for than were measured, and for a scan that is no circle about z.
    """
    require_circle(scan, 'the completion of a scan')
    return filled(without_effects(scan, cloud), views, cloud.render)


def filled(scan: Scan, views: int, render) -> Scan:
    """A scan of `views` views: the given ones and those between them, by `render`, a function of their geometry.

    Raises InputError where fewer views are asked for than are given.
    """
    geometry = scan.geometry
    if views < len(scan):
        raise InputError(f'{views} views were asked for, but {len(scan)} are measured: ask for more')
    if views == len(scan):
        return scan
    rendered = replace(geometry, angles=missing_angles(geometry.angles, views, geometry))
    both = replace(geometry, angles=np.concatenate([geometry.angles, rendered.angles]))
    return Scan(both, np.concatenate([scan.projections, render(rendered)]))
