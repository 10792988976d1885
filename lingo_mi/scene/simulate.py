"""From a scene to a scan: renders all views of its objects, or takes its measured projections, and chooses views."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.progress import Progress
from lingo_mi.effects.forward import Effects, find_effects
from lingo_mi.files.volumes import Volume
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.geometry.trajectories import spread
from lingo_mi.projectors import cutoff, grid
from lingo_mi.projectors.objects import GridInCube, find_objects
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.sampling import grid_values
from lingo_mi.projectors.view import View
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.checks import check_memory, warn_if_truncated
from lingo_mi.scene.load import LoadedScene
from lingo_mi.scene.truth import ScannedVolume, fills_grid, true_volume


def take_scan(
    loaded: LoadedScene, views: int = 0, volume: Volume | None = None, seed: int = 0, truth: bool = True
) -> Dataset:
    """The scan of a scene: its measured projections if the scanner has any; otherwise all views are rendered.

    Held-out views are the scanner's test views, or the remaining views if it has none.

    Parameters
    ----------
    views : int
        Number of views to fit, evenly spaced among the scanner's (0: all).
    volume : Volume or None
        `files.volumes.Volume` to scan instead of the scene's objects.
    seed : int
        Seed of the detector's noise, if it has any.
    truth : bool
        Whether the data set gets the true volume, if that is known on the scanner's grid.
    """
    scanner = loaded.scanner
    if volume is None and scanner.dataset is not None:
        dataset = choose_views(with_effects(scanner.dataset, loaded), views)
        warn_if_truncated(dataset.train.geometry)
        return dataset
    geometry, test = scanner.geometry, scanner.test_geometry
    if views:  # fails early
        spread(len(geometry), views)
    effects = find_effects(loaded.scene, scanner)
    if volume is not None:
        geometry = geometry.on(Grid(volume.data.shape, volume.spacing, geometry.grid.centre))
        check_memory(geometry, test)
        test = test and test.on(Grid(volume.data.shape, volume.spacing, test.grid.centre))
        objects = [ScannedVolume(volume.data, geometry.grid)]
    else:
        try:
            objects = find_objects(loaded.scene)
        except InputError as error:
            raise InputError(f'{loaded.path}: {error}') from None
    warn_if_truncated(geometry)
    keys = np.arange(len(geometry) + (len(test) if test is not None else 0))
    if views and test is not None:  # unused views are needed only if there are no test views
        chosen = spread(len(geometry), views)
        keys = np.concatenate([chosen, keys[len(geometry) :]])
        geometry = geometry.subset(chosen)
    every = geometry if test is None else geometry.joined(test)
    if effects is None:
        everything = Scan(every, render_objects(objects, every))
    else:
        try:
            everything = Scan(every, render_with(effects, objects, every, keys, seed), effects=effects)
        except InputError as error:
            raise InputError(f'{loaded.path}: {error}') from None
    train = replace(
        everything.subset(slice(0, len(geometry))), geometry=geometry
    )  # as given: joining may make poses of it
    held_out = everything.subset(slice(len(geometry), None)) if test is not None else None
    true = true_volume(objects, geometry.grid) if truth else None
    if truth and true is None:
        warnings.warn(
            f'{loaded.path}: the volume is not compared with the true one, since the scanner has other voxels (nVoxel, dVoxel) '
            'than the object, or the object is in a shapegroup; give both the same, if the scene lets you',
            stacklevel=2,
        )
    return choose_views(Dataset(train, held_out, true), 0 if test is not None else views)


def with_effects(dataset: Dataset, loaded: LoadedScene) -> Dataset:
    """The data set with the effects of the scene's tube and detector."""
    effects = find_effects(loaded.scene, loaded.scanner)
    if effects is None and dataset.train.effects is None:
        return dataset  # stored views stay where they are
    return replace(
        dataset,
        train=replace(dataset.train, effects=effects),
        test=dataset.test and replace(dataset.test, effects=effects),
    )


def choose_views(dataset: Dataset, views: int) -> Dataset:
    """A data set with `views` evenly spaced views to fit (0: all). The others are held out if there are no held-out views."""
    train, test, volume = dataset.train, dataset.test, dataset.volume
    if not views or views == len(train):
        return dataset
    chosen = spread(len(train), views)
    rest = np.setdiff1d(np.arange(len(train)), chosen)
    return Dataset(train.subset(chosen), test if test is not None else train.subset(rest), volume)


def render_objects(objects: Sequence, geometry: Geometry, extent: float = cutoff.SIMULATE) -> np.ndarray:
    """Line integrals of all objects in all views, float32 [view, v, u]; Gaussians end at `extent` standard deviations."""
    total = np.zeros((len(geometry), *geometry.nDetector), np.float32)
    with Progress('Scan', len(geometry) * len(objects)) as bar:
        for k, obj in enumerate(objects):

            def report(done, _):
                bar.update(k * len(geometry) + done)

            same_box = isinstance(obj, GridInCube) and fills_grid(obj, geometry.grid)
            if isinstance(obj, ScannedVolume):
                total += obj.project(geometry, report)
            elif same_box:  # skips empty margins, which rendering through the scene may not
                total += grid.project_volume(grid_values(obj), geometry, report)
            else:
                rays = geometry.rays(curved=True)
                for i in range(len(geometry)):
                    view = View.of(rays, i, *geometry.nDetector)
                    total[i] += obj.line_integrals(view, RenderOptions(extent)).numpy().reshape(geometry.nDetector)
                    report(i + 1, None)
    return total


def render_with(
    effects: Effects,
    objects: Sequence,
    geometry: Geometry,
    keys: np.ndarray,
    seed: int,
    extent: float = cutoff.SIMULATE,
) -> np.ndarray:
    """`render_objects` as measured by a detector. keys: keys of the views' noise."""
    objects = [obj.in_box() if isinstance(obj, ScannedVolume) else obj for obj in objects]
    out = np.empty((len(geometry), *geometry.nDetector), np.float32)
    rays = geometry.rays(curved=True)
    with Progress('Scan', len(geometry)) as bar:
        for i in range(len(geometry)):
            view = View.of(rays, i, *geometry.nDetector)
            keyed = replace(effects, index=int(keys[i]))
            expected = keyed.line_integrals(objects, view, RenderOptions(extent))
            out[i] = keyed.measured(expected, view, seed).numpy().reshape(out.shape[1:])
            bar.update(i + 1)
    return out
