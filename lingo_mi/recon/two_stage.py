"""The two-stage way: views that were not measured are rendered from a fitted cloud, then a volume is made of all of them."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..geometry import Geometry
from ..scan import Dataset, Scan
from ..scanning import load_scene, render_objects
from ..xray.objects import Ellipsoids, find_objects
from .circle import require_circle
from .fdk import gaps


def load_cloud(path) -> tuple[Ellipsoids, Geometry]:
    """The cloud of Gaussians of a scene such as a fit's result.xml, and the scan it was fitted to.

    Raises InputError where the scene holds anything else.
    """
    loaded = load_scene(Path(path))
    objects = find_objects(loaded.scene)
    if len(objects) != 1 or not isinstance(objects[0], Ellipsoids):
        raise InputError(f"{path}: is no cloud of Gaussians; give the result.xml of a fit")
    return objects[0], loaded.scanner.geometry


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


def complete(scan: Scan, cloud: Ellipsoids, views: int) -> Scan:
    """A scan of `views` views: the measured ones, and those between them rendered from the cloud.

    Raises InputError where fewer views are asked for than were measured, and for a scan that is no circle about z.
    """
    require_circle(scan, 'the completion of a scan')
    geometry = scan.geometry
    if views < len(scan):
        raise InputError(f'{views} views were asked for, but {len(scan)} are measured: ask for more')
    if views == len(scan):
        return scan
    rendered = replace(geometry, angles=missing_angles(geometry.angles, views, geometry))
    both = replace(geometry, angles=np.concatenate([geometry.angles, rendered.angles]))
    return Scan(both, np.concatenate([scan.projections, render_objects([cloud], rendered)]))
