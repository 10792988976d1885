"""Reconstruction on voxels timed against RTK and diffct on the CPU: projector, transpose, FDK, one SART iteration.

The Shepp-Logan phantom on size^3 voxels, views of size x size pixels over a full turn. In every repeat, the packages run each
operation in turn, on the same cores, from arrays in memory to an array in memory. The deviation is the relative RMS difference
from our result, without the outermost voxels (RTK leaves out their outer halves). It is large where methods differ: diffct
projects constant voxels (Siddon), ours and RTK's projectors interpolate (Joseph); RTK's SART backprojects by interpolation on
the panel, ours by the matched transpose. `exact` is our own projector without Joseph's error, and its transpose.

    result = measure(size=64, views=50, repeats=3)
    result['operations']['FDK']['RTK']['ratio']
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from lingo_mi import phantoms
from lingo_mi.common import runtime
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors.fastest import projector_class
from lingo_mi.projectors.grid_pair import GridPair
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.rectify import can_rectify
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.sart import blocks, sweep
from lingo_mi.reconstruction.system import System
from lingo_mi.scan import Scan
from studies.benchmarks import rtk_bridge

Operations = dict[str, Callable[[], np.ndarray]]  # by name: projector, transpose, FDK, SART


def measure(size: int, views: int, repeats: int, tilt: float = 0.0, say: Callable[[str], object] = print) -> dict:
    """Times of all packages, `compare`d, with what they were measured on.

    Parameters
    ----------
    size : int
        Voxels and pixels along a side.
    repeats : int
        Rounds; the first one, which compiles, comes on top.
    tilt : float
        Tilt of the axis of rotation against the volume's, about x, degrees.
    say : callable
        Called with a line for each package that is not installed.
    """
    cores = runtime.cores()
    runtime.use_threads(cores)
    volume = phantoms.make('shepp_logan', size).data
    geometry = Geometry.cone(
        DSO=1000, DSD=1500, nDetector=size, dDetector=512 / size, nVoxel=size, dVoxel=256 / size, angles=circular(views)
    )
    if tilt:
        rays = geometry.rays().moved(Rotation.from_euler('x', tilt, degrees=True).as_matrix())
        geometry = Geometry.from_poses(rays, size, nVoxel=size, dVoxel=256 / size)
    empty = Scan(geometry, np.zeros((views, size, size), np.float32))
    scan = Scan(geometry, pair(projector_class(geometry), empty, volume)['projector']())
    packages = dict(ours=ours(scan, volume), exact=pair(GridPair, scan, volume))
    for name, make in (('RTK', rtk), ('diffct', diffct)):
        functions = make(scan, volume, cores)
        if functions is None:
            say(f'{name}: not installed, left out')
        else:
            packages[name] = functions
    scanned = dict(size=size, views=views, tilt=tilt)
    return scanned | dict(variant=mi.variant(), cores=cores, repeats=repeats, operations=compare(packages, repeats))


def describe(result: dict) -> Iterator[str]:
    """Describe the result of `measure` line by line."""
    side = result['size']
    yield (
        f'{side}^3 voxels, {result["views"]} views of {side} x {side} pixels, tilted by {result["tilt"]:g} degrees, '
        f'{result["variant"]}, {result["cores"]} cores, medians of {result["repeats"]} repeats'
    )
    for operation, numbers in result['operations'].items():
        parts = [f'{operation:9} ours {numbers["ours"]["seconds"]:8.3f} s']
        parts += [
            f'{name} {x["seconds"]:8.3f} s, ratio {x["ratio"]:6.2f}, deviation {x["deviation"]:.2g}'
            for name, x in numbers.items()
            if name != 'ours'
        ]
        yield '   '.join(parts)


def pair(kind: type, scan: Scan, volume: np.ndarray) -> Operations:
    """A projector of `volume` [x, y, z], and its transpose of the scan's projections. kind: its class."""
    geometry = scan.geometry
    A, views = kind(geometry), np.arange(len(geometry))

    def project():
        images = A.forward(mi.Float(volume.ravel()), views)[0].numpy()
        return images.reshape(len(views), *geometry.nDetector[::-1]).transpose(0, 2, 1)

    def transpose():
        return A.adjoint(A.images(scan.projections), views).numpy().reshape(geometry.grid.shape)

    return dict(projector=project, transpose=transpose)


def ours(scan: Scan, volume: np.ndarray) -> Operations:
    """Our operations: a `pair`, SART, and FDK where the panel is one that it can take."""
    geometry = scan.geometry

    def sart():
        system = System(scan)
        x = sweep(
            system, system.start(None), 1.0, blocks(geometry.angles, 1, 'ordered', np.random.default_rng(0)), True
        )
        dr.eval(x)
        return system.volume(x)

    fdk = dict(FDK=lambda: run_algorithm(scan, FDK()).volume) if can_rectify(scan) else {}
    return pair(projector_class(geometry), scan, volume) | fdk | dict(SART=sart)


def rtk(scan: Scan, volume: np.ndarray, cores: int) -> Operations | None:
    """RTK's operations, or None if it is not installed."""
    try:
        itk: Any = importlib.import_module('itk')
        itk.RTK  # noqa: B018 - loads it
    except (ImportError, AttributeError):
        return None
    geometry = scan.geometry
    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(cores)
    return dict(
        projector=lambda: rtk_bridge.project(volume, geometry, itk),
        transpose=lambda: rtk_bridge.backproject(scan, itk),
        FDK=lambda: rtk_bridge.reconstruct('FDK', scan, itk),
        SART=lambda: rtk_bridge.reconstruct(
            'SART', scan, itk, NumberOfIterations=1, NumberOfProjectionsPerSubset=1, Lambda=1.0, EnforcePositivity=True
        ),
    )


def diffct(scan: Scan, volume: np.ndarray, cores: int) -> Operations | None:
    """diffct's operations (PyTorch backend), or None if it is not installed."""
    try:
        import torch
        from diffct import Projector  # pyright: ignore[reportMissingImports] - optional
        from diffct import fdk as their_fdk  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    torch.set_num_threads(cores)
    geometry = scan.geometry
    rays = geometry.rays()
    pixel, voxel = geometry.dDetector[::-1], geometry.grid.spacing[::-1]
    place = [rays.source, rays.centre(geometry.nDetector), rays.u / pixel[0], rays.v / pixel[1]]
    trajectory = tuple(torch.tensor(np.ascontiguousarray(x), dtype=torch.float32) for x in place)
    shapes = dict(detector_spacing=pixel, voxel_spacing=voxel, backend='torch')
    projector = Projector(trajectory, geometry.grid.shape[::-1], geometry.nDetector[::-1], **shapes)

    def views():
        return torch.from_numpy(np.ascontiguousarray(scan.projections.transpose(0, 2, 1)))

    def project():
        image = projector.project(torch.from_numpy(np.ascontiguousarray(volume.transpose(2, 1, 0))))
        return image.numpy().transpose(0, 2, 1)

    def reconstruct():
        angles = torch.tensor(geometry.angles, dtype=torch.float32)
        return their_fdk(views(), trajectory, geometry.grid.shape[::-1], angles, **shapes).numpy().transpose(2, 1, 0)

    return dict(
        projector=project, transpose=lambda: projector.backproject(views()).numpy().transpose(2, 1, 0), FDK=reconstruct
    )


def compare(packages: dict[str, Operations], repeats: int) -> dict:
    """Return medians over the repeats by operation and package: seconds and, for packages other than 'ours', ratio (their time
    over ours: above 1 they are slower) and deviation (relative RMS difference from our result)."""
    seconds, deviation, reference = {}, {}, np.empty(0)
    for turn in range(repeats + 1):
        for operation in packages['ours']:
            for name, functions in packages.items():
                if operation not in functions:
                    continue
                begun = time.perf_counter()
                result = functions[operation]()
                if turn:
                    seconds.setdefault((operation, name), []).append(time.perf_counter() - begun)
                    continue
                if operation != 'projector':
                    result = result[1:-1, 1:-1, 1:-1]
                if name == 'ours':
                    reference = result.copy()
                else:
                    deviation[operation, name] = float(np.linalg.norm(result - reference) / np.linalg.norm(reference))
    out = {}
    for (operation, name), taken in seconds.items():
        entry = out.setdefault(operation, {})[name] = dict(seconds=float(np.median(taken)))
        if name != 'ours':
            entry |= dict(
                ratio=entry['seconds'] / out[operation]['ours']['seconds'], deviation=deviation[operation, name]
            )
    return out
