"""From a scene to a scan: load it, find its scanner, render or read every view, sample the true volume."""
from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from .effects.forward import Effects, find_effects
from .errors import InputError
from .geometry import Geometry, spread
from .memory import room
from .progress import Progress
from .scan import Dataset, Scan
from .xray import grid
from .xray.frame import View
from .xray.objects import Ellipsoids, GridInCube, find_objects
from .xray.quality import Quality
from .xray.sampling import grid_values, on_grid


@dataclass(frozen=True)
class LoadedScene:
    """A scene, its scanner and where they came from."""

    scene: object
    scanner: object
    path: Path

    @property
    def name(self) -> str:
        return self.path.stem


def load_scene(path, parameters: dict | None = None) -> LoadedScene:
    """Load a Mitsuba scene with a `ct_scanner`.

    parameters   values for the scene's own `<default>` names

    Raises InputError, in one line, for whatever Mitsuba or a plugin finds wrong.
    """
    path = Path(path)
    unknown = set(parameters or {}) - defaults(path)
    if unknown:
        raise InputError(f'{path}: the scene has no parameter {", ".join(sorted(unknown))}; '
                         f'it has {", ".join(sorted(defaults(path))) or "none"}')
    try:
        # By one thread: with several, Mitsuba has failed to make a plugin (bad_alloc in a gridvolume) once in thousands.
        scene = mi.load_file(str(path), parallel=False, **(parameters or {}))
    except Exception as error:  # Mitsuba wraps a plugin's own exceptions in RuntimeErrors of many lines
        raise InputError(f'{path}: {plain(error)}') from None
    if not isinstance(scene, mi.Scene):
        raise InputError(f'{path}: this is a {type(scene).__name__}, not a scene')
    scanner = next((s for s in scene.sensors() if hasattr(s, 'geometry')), None)
    if scanner is None:
        raise InputError(f'{path}: the scene has no scanner; add <sensor type="ct_scanner">')
    check_memory(scanner.geometry, scanner.test_geometry)
    try:
        find_effects(scene, scanner)
    except InputError as error:
        raise InputError(f'{path}: {error}') from None
    return LoadedScene(scene, scanner, path)


def check_memory(*geometries: Geometry | None, views: int = 0, needed: float = 0):
    """Refuse, before anything is allocated, a scan that this process cannot hold.

    views    of all geometries together (0: as many as they have)
    needed   bytes that an algorithm takes at its peak (0: the least there is, the voxels as read, fitted and compared, and the
             projections as measured and rendered)
    """
    known = [g for g in geometries if g is not None]
    views = views or sum(map(len, known))
    voxels, pixels = math.prod(known[0].nVoxel), views * math.prod(known[0].nDetector)
    needed = needed or 4 * (3 * voxels + 2 * pixels)
    if needed > (has := room()):
        size = [' x '.join(map(str, counts)) for counts in (known[0].nVoxel, known[0].nDetector)]
        raise InputError(f'{size[0]} voxels and {views} views of {size[1]} pixels need at least {needed / 2 ** 30:,.1f} GiB of '
                         f'memory, but this process may take {has / 2 ** 30:,.1f} GiB: lower nVoxel, nDetector or the views')


def defaults(path) -> set[str]:
    """Names of a scene file's `<default>` parameters. Raises InputError where the file is missing or no XML."""
    if not Path(path).is_file():
        raise InputError(f'{path}: {"is a folder, not a scene" if Path(path).is_dir() else "there is no such scene"}')
    try:
        return {node.get('name', '') for node in ElementTree.parse(path).iter('default')}
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise InputError(f'{path}: this is not a scene in XML ({error})') from None


def plain(error: Exception) -> str:
    """The one line of an error that a user needs: ours if a plugin raised it, with the element's line, else the gist of
    Mitsuba's."""
    text = str(error)
    ours = re.findall(r'InputError: (.*)', text)
    if ours:
        lines = re.findall(r'\(line (\d+), col \d+\)', text)
        return (f'line {lines[-1]}: ' if lines else '') + ours[-1].strip()
    if '"ellipsoids"' in text and '(sizes: 0, 1)' in text:  # what becomes of no Gaussians in Mitsuba
        return 'the shape ellipsoids holds no Gaussian: give it a file or data of at least one'
    text = re.sub(r'Traceback \(most recent call last\):\n(?:[ \t].*\n)*', '', text)
    lines = [re.sub(r'^\[[\w.]+:\d+\] *', '', line.strip()) for line in text.splitlines() if line.strip()]
    return ' '.join(lines)[:400] or type(error).__name__


def take_scan(loaded: LoadedScene, views: int = 0, volume=None, seed: int = 0) -> Dataset:
    """The scan of a scene: measured projections if the scanner has them, else every view rendered, with a progress bar.

    views    how many to fit, evenly spaced among the scanner's (0: all of them)
    volume   `files.volumes.Volume` to scan instead of the scene's objects
    seed     of the detector's noise, where the scene has one with noise

    The views held out are the scanner's test views, or, if it has none, those left over. The true volume is given
    where it is known on the scanner's grid.
    """
    scanner = loaded.scanner
    if volume is None and scanner.dataset is not None:
        dataset = choose_views(with_effects(scanner.dataset, loaded), views)
        warn_if_truncated(dataset.train.geometry)
        return dataset
    geometry, test = scanner.geometry, scanner.test_geometry
    if views:  # before the work, not after
        spread(len(geometry), views)
    effects = find_effects(loaded.scene, scanner)
    if volume is not None:
        geometry = geometry.with_volume(volume.data.shape, volume.spacing)
        check_memory(geometry, test)
        test = test and test.with_volume(volume.data.shape, volume.spacing)
        objects = [_Volume(volume.data, geometry)]
    else:
        try:
            objects = find_objects(loaded.scene)
        except InputError as error:
            raise InputError(f'{loaded.path}: {error}') from None
    warn_if_truncated(geometry)
    keys = np.arange(len(geometry) + (len(test) if test is not None else 0))
    if views and test is not None:  # unused views are needed only where nothing else is held out
        chosen = spread(len(geometry), views)
        keys = np.concatenate([chosen, keys[len(geometry):]])
        geometry = geometry.subset(chosen)
    every = geometry if test is None else geometry.joined(test)
    if effects is None:
        everything = Scan(every, render_objects(objects, every))
    else:
        try:
            everything = Scan(every, render_with(effects, objects, every, keys, seed), effects=effects)
        except InputError as error:
            raise InputError(f'{loaded.path}: {error}') from None
    train = everything.subset(slice(0, len(geometry)))
    held_out = everything.subset(slice(len(geometry), None)) if test is not None else None
    return choose_views(Dataset(train, held_out, _truth(objects, geometry)), 0 if test is not None else views)


def with_effects(dataset: Dataset, loaded: LoadedScene) -> Dataset:
    """Measured projections as the tube and the detector of a scene saw them."""
    effects = find_effects(loaded.scene, loaded.scanner)
    return replace(dataset, train=replace(dataset.train, effects=effects),
                   test=dataset.test and replace(dataset.test, effects=effects))


def choose_views(dataset: Dataset, views: int) -> Dataset:
    """A data set with `views` evenly spaced views to fit (0: all); those left over are held out if none were before."""
    train, test, volume = dataset.train, dataset.test, dataset.volume
    if not views or views == len(train):
        return dataset
    chosen = spread(len(train), views)
    rest = np.setdiff1d(np.arange(len(train)), chosen)
    return Dataset(train.subset(chosen), test if test is not None else train.subset(rest), volume)


class _Volume:
    """A volume on the scan's own grid, to be scanned."""

    def __init__(self, data, geometry):
        self.data, self.box = data, geometry

    def project(self, geometry, progress):
        return grid.project(self.data, geometry, progress)

    def in_box(self) -> GridInCube:
        """The same as an object of a scene."""
        centre, half = np.array(self.box.offOrigin), np.array(self.box.sVoxel) / 2
        return GridInCube.of(self.data, centre - half, centre + half, 'volume')


def render_objects(objects, geometry, extent: float = 8.) -> np.ndarray:
    """Line integrals of all objects in all views, float32 [view, v, u]; Gaussians end at `extent` standard deviations."""
    total = np.zeros((len(geometry), *geometry.nDetector), np.float32)
    with Progress('Scan', len(geometry) * len(objects)) as bar:
        for k, thing in enumerate(objects):
            def report(done, _):
                bar.update(k * len(geometry) + done)
            same_box = isinstance(thing, GridInCube) and _on_grid(thing, geometry)
            if isinstance(thing, _Volume):
                total += thing.project(geometry, report)
            elif same_box:  # skips empty margins, which rendering through the scene may not
                total += grid.project(grid_values(thing), geometry, report)
            else:
                frames = geometry.frames()
                for i in range(len(geometry)):
                    view = View.of(frames, i, *geometry.nDetector)
                    total[i] += thing.line_integrals(view, extent, True).numpy().reshape(geometry.nDetector)
                    report(i + 1, None)
    return total


def render_with(effects: Effects, objects, geometry, keys, seed, extent: float = 8.) -> np.ndarray:
    """`render_objects` as a detector measures it; keys are those of the views' noise."""
    objects = [thing.in_box() if isinstance(thing, _Volume) else thing for thing in objects]
    out = np.empty((len(geometry), *geometry.nDetector), np.float32)
    frames = geometry.frames()
    with Progress('Scan', len(geometry)) as bar:
        for i in range(len(geometry)):
            view = View.of(frames, i, *geometry.nDetector)
            one = replace(effects, index=int(keys[i]))
            expected = one.line_integrals(objects, view, Quality(extent))
            out[i] = one.measured(expected, view, seed).numpy().reshape(out.shape[1:])
            bar.update(i + 1)
    return out


def _on_grid(thing: GridInCube, geometry: Geometry) -> bool:
    """Whether a grid is the scanner's own."""
    centre, half = np.array(geometry.offOrigin), np.array(geometry.sVoxel) / 2
    return (tuple(thing.size) == geometry.nVoxel and np.allclose(thing.low, centre - half, atol=1e-4 * half.max())
            and np.allclose(thing.high, centre + half, atol=1e-4 * half.max()))


def _truth(objects, geometry) -> np.ndarray | None:
    """The true density on the scanner's grid [x, y, z], where every object can be sampled on it."""
    total = np.zeros(geometry.nVoxel, np.float32)
    corner = np.array(geometry.offOrigin) - np.array(geometry.sVoxel) / 2
    for thing in objects:
        if isinstance(thing, _Volume):
            total += thing.data
        elif not isinstance(thing, GridInCube) or _on_grid(thing, geometry):
            total += on_grid(thing, corner, geometry.dVoxel, geometry.nVoxel)
        else:
            return None
    return total


def voxelize_cloud(cloud: Ellipsoids, geometry: Geometry, extent: float) -> np.ndarray:
    """Density of a cloud of Gaussians at the voxel centres of the scan's grid, float32 [x, y, z], per mm.

    extent   cut-off in standard deviations
    """
    corner = np.array(geometry.offOrigin) - np.array(geometry.sVoxel) / 2
    return on_grid(cloud, corner, geometry.dVoxel, geometry.nVoxel, extent)


def warn_if_truncated(geometry: Geometry):
    """Say so where the volume's midplane is wider than what the panels see of it."""
    frames, centre = geometry.frames(), np.array(geometry.offOrigin)
    widest, columns = max(geometry.sVoxel[:2]), geometry.nDetector[1]
    cut = 0
    for view in range(len(frames)):
        across = frames.u[view] / np.linalg.norm(frames.u[view]) * widest / 2
        x, _ = frames.project(np.stack([centre - across, centre + across]), view)
        cut += not (x.min() >= -1e-4 * columns and x.max() <= columns * (1 + 1e-4))  # also where it is NaN
    if cut:
        import warnings
        warnings.warn(f'the volume is {widest:g} mm wide, and the panel does not see all of it in {cut} of {len(frames)} '
                      'views: projections may be truncated', stacklevel=2)
