"""The two-stage way: views that were not measured are rendered from a fitted cloud, then a volume is made of all of them."""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..effects.forward import Effects, find_effects
from ..errors import InputError
from ..geometry import Geometry
from ..scan import Dataset, Scan
from ..scanning import load_scene, render_objects
from ..xray.objects import Ellipsoids, find_objects
from .circle import require_circle
from .corrections import corrected
from .fdk import gaps


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


def load_cloud(path) -> FittedCloud:
    """The cloud of a scene such as a fit's result.xml.

    Raises InputError where the scene holds anything else.
    """
    loaded = load_scene(Path(path))
    objects = find_objects(loaded.scene)
    quality = getattr(loaded.scene.integrator(), 'quality', None)
    if quality is None or len(objects) != 1 or not isinstance(objects[0], Ellipsoids):
        raise InputError(f"{path}: is no cloud of Gaussians; give the result.xml of a fit")
    return FittedCloud(objects[0], loaded.scanner.geometry, quality.extent, find_effects(loaded.scene, loaded.scanner))


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


def without_effects(scan: Scan, cloud: FittedCloud) -> Scan:
    """The line integrals of measured views, `corrected` by the cloud for the effects that its fit has modelled; where it has
    modelled none, the projections themselves."""
    return scan if cloud.effects is None else corrected(scan, cloud.effects, [cloud.gaussians], cloud.extent)


def complete(scan: Scan, cloud: FittedCloud, views: int) -> Scan:
    """A scan of `views` views: the measured ones, `without_effects`, and those between them rendered from the cloud.

    Raises InputError where fewer views are asked for than were measured, and for a scan that is no circle about z.
    """
    require_circle(scan, 'the completion of a scan')
    geometry = scan.geometry
    if views < len(scan):
        raise InputError(f'{views} views were asked for, but {len(scan)} are measured: ask for more')
    scan = without_effects(scan, cloud)
    if views == len(scan):
        return scan
    rendered = replace(geometry, angles=missing_angles(geometry.angles, views, geometry))
    both = replace(geometry, angles=np.concatenate([geometry.angles, rendered.angles]))
    return Scan(both, np.concatenate([scan.projections, render_objects([cloud.gaussians], rendered, cloud.extent)]))
