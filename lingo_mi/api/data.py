"""Scans to work on: simulated from a scene, a phantom or a volume, or read from files."""

from __future__ import annotations

import dataclasses
from os import PathLike
from typing import Any

import numpy as np

from lingo_mi.common import parsing
from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import nearest, whole_number
from lingo_mi.common.progress import Progress
from lingo_mi.common.runtime import drjit_lock, ensure_variant
from lingo_mi.files.scans import read_scan
from lingo_mi.geometry import Geometry
from lingo_mi.geometry.trajectories import spread
from lingo_mi.phantoms import Phantom, make
from lingo_mi.phantoms.x3d_scan import project_phantom
from lingo_mi.phantoms.x3d_scan import scan as x3d_scan
from lingo_mi.projectors import grid
from lingo_mi.raw.importing import import_raw
from lingo_mi.raw.options import Options
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.checks import check_memory, require_densities, warn_if_truncated
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.shipped import scene_path
from lingo_mi.scene.simulate import choose_views, take_scan
from lingo_mi.storage.file_access import as_path


@drjit_lock()
def simulate(
    source: str | PathLike | Phantom | np.ndarray,
    geometry: Geometry | None = None,
    *,
    views: int | None = None,
    held_out: Geometry | None = None,
    seed: int = 0,
    parameters: dict | None = None,
    progress: bool = True,
) -> Dataset:
    """Simulate a scan: exact line integrals of an object, and then the effects that a scene names.

    Parameters
    ----------
    source : path-like or Phantom or ndarray
        A Mitsuba scene with a `ct_scanner` (its path, or the name of a shipped one, such as 'x3d_foot'), a `phantom`, or a volume
        [x, y, z] of densities per mm (NumPy, or anything with `__array__` or `__dlpack__`).
    geometry : Geometry or None
        The scanner of a phantom or a volume. A volume must have `geometry.grid.shape` voxels. Without a geometry, a phantom is
        scanned as in X3D: a cone beam, `views` views over half a turn (default: 50), and as many random ones held out. If the
        geometry has another grid, the phantom's voxels are scanned instead of its formula.
    views : int or None
        How many of the views to fit, evenly spaced (default: all). The rest are held out, unless the scene or `held_out`
        provides held-out views. For a phantom without a geometry: how many views to scan.
    held_out : Geometry or None
        Further views of `geometry`, to measure the quality of new views.
    seed : int
        Seed of random angles and of the noise of a scene's detector.
    parameters : dict or None
        Values for the `<default>` names of a scene file.
    progress : bool
        Whether to show a progress bar on standard error. Scenes always show one.

    Returns
    -------
    Dataset
        `train` and `test` (or None) are `Scan`s of projections [view, v, u], density times mm. `volume` [x, y, z] is the true
        density, if it is known.

    Raises
    ------
    InputError
        If the source is unknown, does not fit the geometry, needs more memory than there is, or is a volume whose negative values
        look like Hounsfield units (`docs/how_to/own_volume.md` says how to convert them).

    Examples
    --------
    >>> data = lm.simulate('x3d_foot', views=25)
    >>> data = lm.simulate(lm.phantom('foot', size=96), geometry, views=25)
    """
    ensure_variant()
    seed = parsing.seed(seed)
    views = 0 if views is None else whole_number('views', views, 1)
    for name, argument in (('geometry', geometry), ('held_out', held_out)):
        if argument is not None:
            require_type(name, argument, Geometry, 'such as lm.Geometry.cone(...)')
    if parameters is not None:
        require_type('parameters', parameters, dict)
    if isinstance(source, (str, PathLike)):
        if geometry is not None or held_out is not None:
            raise InputError(f'{source}: a scene has its own scanner; leave out geometry and held_out')
        scene = load_scene(scene_path(source), {k: str(v) for k, v in (parameters or {}).items()})
        return take_scan(scene, views, seed=seed)
    if parameters:
        raise InputError('parameters belong to a scene file, and this source is not one')
    if isinstance(source, Phantom) and geometry is None:
        if held_out is not None:
            raise InputError('held_out needs a geometry: give the scanner of the views to fit, too')
        with Progress('Scan', 2 * (views or 50), shown=progress) as bar:
            return x3d_scan(source, views or 50, seed, lambda done, _: bar.update(done))
    if geometry is None:
        raise InputError('a volume needs a scanner: give a geometry, such as lm.Geometry.cone(...)')
    volume = source.data if isinstance(source, Phantom) else as_numpy(source, 'the volume', np.float32)
    if volume.shape != geometry.grid.shape:
        raise InputError(
            f'the volume has the shape {volume.shape}, but the geometry says nVoxel = {geometry.grid.shape}'
        )
    if views:  # fails early
        spread(len(geometry), views)
    require_densities(volume)
    check_memory(geometry, held_out)
    warn_if_truncated(geometry)
    every = geometry if held_out is None else geometry.joined(held_out)
    with Progress('Scan', len(every), shown=progress) as bar:

        def report(done, _):
            bar.update(done)

        if isinstance(source, Phantom):
            projections = project_phantom(source, every, report)
        else:
            projections = grid.project_volume(volume, every, report)
    scan = Scan(every, projections)
    if held_out is None:
        return choose_views(Dataset(scan, None, volume), views)
    # The given geometry, which joining may have turned into one of poses.
    train, test = Scan(geometry, scan.projections[: len(geometry)]), scan.subset(slice(len(geometry), None))
    return choose_views(Dataset(train, test, volume), views)


def load(path: str | PathLike, geometry: str | PathLike | None = None, *, views: int | None = None) -> Dataset:
    """Read a measured or stored scan.

    Parameters
    ----------
    path : path-like
        A pickle of NAF, SAX-NeRF or X3D (read without running code), a folder of R2-Gaussian or of EXR images, `scan.npy`,
        `scan.zarr` or `scan.h5` [view, v, u] with `scan.yml` beside it, or the .npz of a public scan.
    geometry : path-like or None
        The geometry file of an .npy, .zarr or .h5 (default: the .yml of the same name).
    views : int or None
        How many of the views to fit, evenly spaced (default: all). The rest are held out, unless the file has held-out views.

    Returns
    -------
    Dataset
        Line integrals ln(I0 / I) [view, v, u].

    Raises
    ------
    InputError
        If the file is missing, damaged, or contradicts its geometry.

    Examples
    --------
    >>> data = lm.load('foot_50.pickle', views=25)
    """
    if geometry is not None and not isinstance(geometry, (str, PathLike)):
        raise InputError(
            f'geometry must be the path of a geometry file, not {type(geometry).__name__}; '
            'with a Geometry, make the scan by lm.Scan(geometry, numpy.load(path))'
        )
    views = 0 if views is None else whole_number('views', views, 1)
    dataset = choose_views(read_scan(as_path('path', path), geometry), views)
    warn_if_truncated(dataset.train.geometry)
    return dataset


def load_raw(
    frames: str | PathLike, geometry: str | PathLike | Geometry | None = None, *, progress: bool = True, **options: Any
) -> Scan:
    """Read a scanner's raw frames and turn them into line integrals, one frame at a time.

    Parameters
    ----------
    frames : path-like
        A folder of images (.tif, .edf, .png, .jp2, .his, .hnd, .hnc, .xim), a multi-page .tif, a .edf, DICOM (a file or a
        folder), Zeiss' .txrm, .npy [n, v, u], or HDF5 as NXtomo or DXchange.
    geometry : path-like or Geometry or None
        The geometry of whole frames: a `Geometry`, a .yml, a scanner's file (Nikon's .xtekct, NSI's .nsipro, Bruker's .log, GE's
        .pca), or RTK's .xml. None takes it from the file of the frames, such as DICOM or .txrm.
    progress : bool
        Whether to show a progress bar on standard error.
    options
        Flats, darks (files or folders); air (v0, v1, u0, u1), percentile or i0: the air level; exposure (relative to the
        flats); saturation (counts); crop (v0, v1, u0, u1); binning; views (first, end, step); angles (degrees, or their file);
        pixel (mm); rings and outliers (True removes them).
        `lingo_mi.raw.options.Options` describes them. `lingo-mi import` writes the scan to a file.

    Returns
    -------
    Scan
        Its mask `valid` excludes dead, hot and saturated pixels and those without counts.

    Raises
    ------
    InputError
        If something is missing, contradictory or damaged. Black views, and views brighter than the flats, cause a warning.

    Examples
    --------
    >>> scan = lm.load_raw('frames/', 'scanner.yml', flats='flats/', darks='darks/', binning=2)
    """
    require_type('frames', frames, (str, PathLike))
    if geometry is not None:
        require_type('geometry', geometry, (str, PathLike, Geometry))
    accepted = {field.name for field in dataclasses.fields(Options)}
    for name in options.keys() - accepted:
        raise InputError(
            f'load_raw has no option {name!r}{nearest(name, accepted)}; it has {", ".join(sorted(accepted))}'
        )
    return import_raw(frames, geometry, Options(**options), progress)[0]


def phantom(name: str, size: int = 256, seed: int = 0, *, attenuation: str = 'x3d') -> Phantom:
    """A test object made by formula.

    Parameters
    ----------
    name : {'foot', 'chest', 'shepp_logan', 'gaussians', 'mesh'}
        The object.
    size : int
        Voxels a side, 8 to 512.
    seed : int
        Seed of textures, vessels and random Gaussians.
    attenuation : {'x3d', 'real'}
        'x3d': densities from 0 to 1, as in the published tables of X3D and R2-Gaussian. No scanner measures such large
        line integrals. 'real': these densities times 0.0618 per mm, dense cortical bone at 60 keV. Soft tissue of the foot and
        the head is then lighter than water, because the factor is right for bone.

    Returns
    -------
    Phantom
        `data` is float32 [x, y, z], per mm, and `spacing` the voxel size in mm.

    Raises
    ------
    InputError
        For an unknown name or attenuation, a size out of range or a negative seed.

    Examples
    --------
    >>> foot = lm.phantom('foot', size=96)
    """
    return make(name, size, seed, attenuation)
