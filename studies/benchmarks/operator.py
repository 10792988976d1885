"""The operator `Projector` and its transpose beside other packages, and the cost of a call beyond its kernel.

    python -m studies.benchmarks.operator --out docs/tables
    python -m studies.benchmarks.operator --overhead
    python -m studies.benchmarks.operator --on-device --variant cuda_ad_mono

A cone beam of one turn before a flat panel. Every package that is installed is measured in the same process, from an array of
NumPy to an array of NumPy. CPU seconds are summed over all threads of the process: they give the cost of a call even if others
use the machine. The first call, which compiles, is not counted. Packages that take seconds a view are called once on one view,
and the seconds are scaled to all. The adjoint's error is |<A x, y> - <x, A.T y>| / (|A x| |y|) for random x and y, in float64.

`--on-device` measures our operators alone, from arrays of Dr.Jit to arrays of Dr.Jit, which stay on the device. The clocks are
read when the device has finished its work.

`--overhead` takes a scan so small that its kernels take about a millisecond, in one thread. It compares calls through arrays of
NumPy, Dr.Jit, PyTorch and JAX with the bare kernels: the least CPU seconds over all turns, since others on the machine hardly
change the least.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import importlib.metadata
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import lingo_mi
from lingo_mi.common.runtime import cores, use_threads, use_variant
from lingo_mi.functional.projector import Projector
from lingo_mi.geometry import Geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.scan import Scan
from lingo_mi.storage.file_access import replacing
from lingo_mi.validation.provenance import write_provenance
from studies.benchmarks import mbirjax_bridge, rtk_bridge

COLUMNS = (
    'operator',
    'version',
    'views measured',
    'A, CPU s',
    'A.T, CPU s',
    'A, wall s',
    'A.T, wall s',
    'error of the adjoint',
)


@dataclass(frozen=True)
class Pair:
    """A package's operator and its transpose.

    Parameters
    ----------
    forward : callable
        Volume [x, y, z], float32, to projections [view, v, u].
    adjoint : callable
        The other way.
    """

    forward: Callable[[Any], Any]
    adjoint: Callable[[Any], Any]


def ours(geometry: Geometry, model: str) -> Pair:
    A = Projector(geometry, model=model)
    return Pair(A, A.T)


def rtk(geometry: Geometry) -> Pair:
    itk: Any = importlib.import_module('itk')
    itk.RTK  # noqa: B018 - loads it
    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(cores())
    return Pair(
        lambda x: rtk_bridge.project(x, geometry, itk), lambda y: rtk_bridge.backproject(Scan(geometry, y), itk)
    )


def mbir(geometry: Geometry, name: str) -> Pair:
    """MBIRJAX and its port mbirtorch, which have the same interface."""
    model = mbirjax_bridge.model(geometry, importlib.import_module(name))

    def array(result):
        return np.array(result)

    return Pair(
        lambda x: array(model.forward_project(np.ascontiguousarray(x[:, :, ::-1]))),
        lambda y: array(model.back_project(np.ascontiguousarray(y)))[:, :, ::-1],
    )


def diffct(geometry: Geometry) -> Pair:
    import torch
    from diffct import Projector as Theirs  # pyright: ignore[reportMissingImports] - optional

    torch.set_num_threads(cores())
    rays, pixel = geometry.rays(), geometry.dDetector[::-1]
    place = [rays.source, rays.centre(geometry.nDetector), rays.u / pixel[0], rays.v / pixel[1]]
    trajectory = tuple(torch.tensor(np.ascontiguousarray(x), dtype=torch.float32) for x in place)
    A = Theirs(
        trajectory, geometry.grid.shape[::-1], geometry.nDetector[::-1], detector_spacing=pixel,
        voxel_spacing=geometry.grid.spacing[::-1], backend='torch',
    )  # fmt: skip
    return Pair(
        lambda x: A.project(_tensor(x.transpose(2, 1, 0))).numpy().transpose(0, 2, 1),
        lambda y: A.backproject(_tensor(y.transpose(0, 2, 1))).numpy().transpose(2, 1, 0),
    )


def torchtomo(geometry: Geometry) -> Pair:
    import torch
    from torchtomo import ConeBeam  # pyright: ignore[reportMissingImports] - optional

    torch.set_num_threads(cores())
    rays, (n_v, n_u) = geometry.rays(), geometry.nDetector
    v, u = (np.arange(n_v) + 0.5)[:, None, None], (np.arange(n_u) + 0.5)[None, :, None]
    pixels = rays.corner[:, None, None] + u * rays.u[:, None, None] + v * rays.v[:, None, None]
    A = ConeBeam(
        geometry.grid.shape[::-1], _tensor(rays.source), _tensor(pixels), voxel_spacing=geometry.grid.spacing[::-1]
    )
    return Pair(
        lambda x: A(_tensor(x.transpose(2, 1, 0))[None, None])[0, 0].numpy(),
        lambda y: A.adjoint(_tensor(y)[None, None])[0, 0].numpy().transpose(2, 1, 0),
    )


def _tensor(x: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(np.ascontiguousarray(x, np.float32))


# Its package on PyPI, what makes it, and whether it takes seconds a view.
OPERATORS: dict[str, tuple[str, Callable[[Geometry], Pair], bool]] = {
    'lingo_mi, Joseph': ('lingo_mi', lambda g: ours(g, 'joseph'), False),
    'lingo_mi, exact': ('lingo_mi', lambda g: ours(g, 'exact'), False),
    'RTK, Joseph': ('itk-rtk', rtk, False),
    'MBIRJAX': ('mbirjax', lambda g: mbir(g, 'mbirjax'), False),
    'mbirtorch': ('mbirtorch', lambda g: mbir(g, 'mbirtorch'), False),
    'diffct, PyTorch': ('diffct', diffct, True),
    'torchtomo, PyTorch': ('torchtomo', torchtomo, True),
}
OURS = [name for name, (package, _, _) in OPERATORS.items() if package == 'lingo_mi']


def scan(size: int, pixels: int, views: int) -> Geometry:
    """A cone beam of one turn, 256 mm of voxels before a panel of 512 mm."""
    return Geometry.cone(
        DSO=1000,
        DSD=1500,
        nDetector=pixels,
        dDetector=512 / pixels,
        nVoxel=size,
        dVoxel=256 / size,
        angles=circular(views),
    )


def measured(geometry: Geometry, name: str, repeats: int, on_device: bool = False) -> dict[str, Any] | None:
    """A row of the table; None if the package is not installed. on_device: from arrays of Dr.Jit, which only ours takes."""
    package, make, slow = OPERATORS[name]
    part = geometry.subset([0]) if slow else geometry
    try:
        pair = make(part)
    except ImportError:
        return None
    rng = np.random.default_rng(0)
    x = rng.random(part.grid.shape, np.float32)
    y = rng.random((len(part), *part.nDetector), np.float32)
    calls, array = 1 if slow else 1 + repeats, mi.TensorXf if on_device else np.asarray
    ax, forward = _timed(pair.forward, array(x), calls)
    aty, adjoint = _timed(pair.adjoint, array(y), calls)
    error = abs(np.vdot(ax, y) - np.vdot(x, aty)) / (np.linalg.norm(ax) * np.linalg.norm(y))
    (cpu, wall), (cpu_t, wall_t) = len(geometry) / len(part) * np.array([forward, adjoint])
    return dict(zip(COLUMNS, (name, _version(package), len(part), cpu, cpu_t, wall, wall_t, error)))


def _version(package: str) -> str:
    return lingo_mi.__version__ if package == 'lingo_mi' else importlib.metadata.version(package)


def _timed(function, argument, calls: int) -> tuple[np.ndarray, np.ndarray]:
    """The result, float64, and a call's CPU and wall seconds: medians without the first call, if there are several."""
    taken = []
    for _ in range(calls):
        dr.eval(argument)
        dr.sync_thread()
        cpu, wall = time.process_time(), time.perf_counter()
        result = function(argument)
        dr.eval(result)
        dr.sync_thread()
        taken.append((time.process_time() - cpu, time.perf_counter() - wall))
    return np.array(result, float), np.median(taken[-max(1, calls - 1) :], axis=0)


def overhead(geometry: Geometry, turns: int) -> Iterator[tuple[str, float, float]]:
    """A kind of array, and by how many seconds a call of A and of A.T takes longer than the bare kernel."""
    A = Projector(geometry)
    x = np.random.default_rng(0).random(A.domain_shape, np.float32)
    y = A(x)
    kernels, block = A._pair()
    kinds: dict[str, tuple] = {
        'bare kernel': (mi.Float(x.ravel()), mi.Float(y.ravel())),
        'NumPy': (x, y),
        'Dr.Jit': (mi.TensorXf(x), mi.TensorXf(y)),
    }
    for name, library, convert in (('PyTorch', 'torch', 'as_tensor'), ('JAX', 'jax.numpy', 'asarray')):
        try:
            converter = getattr(importlib.import_module(library), convert)
        except ImportError:
            continue
        kinds[name] = converter(x), converter(y)
    bare = (lambda v: dr.eval(kernels.forward(v, block)), lambda v: dr.eval(kernels.adjoint(v, block)))
    least = {name: [np.inf, np.inf] for name in kinds}
    for _ in range(turns):
        for name, values in kinds.items():
            for i, call in enumerate(bare if name == 'bare kernel' else (A, A.T)):
                begun = time.process_time()
                result = call(values[i])
                getattr(result, 'block_until_ready', lambda: None)()
                dr.sync_thread()
                least[name][i] = min(least[name][i], time.process_time() - begun)
    kernel = least.pop('bare kernel')
    yield 'bare kernel', kernel[0], kernel[1]
    for name, result in least.items():
        yield name, result[0] - kernel[0], result[1] - kernel[1]


def main() -> None:
    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('--size', type=int, default=128, help='voxels along a side')
    p.add_argument('--pixels', type=int, default=256, help='pixels along a side')
    p.add_argument('--views', type=int, default=30)
    p.add_argument('--repeats', type=int, default=3, help='calls whose median is taken')
    p.add_argument('--only', nargs='+', choices=list(OPERATORS), help='operators (default: all that can be measured)')
    p.add_argument('--out', type=Path, help='a folder, for operator.csv and its provenance')
    p.add_argument('--variant', help='Mitsuba variant of ours (default: cuda_ad_mono, else llvm_ad_mono)')
    p.add_argument('--on-device', action='store_true', help='measure ours alone, between arrays of Dr.Jit')
    p.add_argument(
        '--overhead', action='store_true', help='measure a call over its kernel, on a small scan, in place of the table'
    )
    args = p.parse_args()
    only = args.only or (OURS if args.on_device else list(OPERATORS))
    if args.on_device and not {*only} <= {*OURS}:
        p.error(f'argument --on-device: only {" and ".join(OURS)} take arrays of Dr.Jit')
    use_variant(args.variant)
    use_threads(1 if args.overhead else cores())
    if args.overhead:
        for name, forward, adjoint in overhead(scan(16, 16, 4), 50 * args.repeats):
            print(f'{name:12} A {1e3 * forward:6.2f} ms, A.T {1e3 * adjoint:6.2f} ms')
        return
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
    geometry, rows = scan(args.size, args.pixels, args.views), []
    for name in only:
        row = measured(geometry, name, args.repeats, args.on_device)
        if row is None:
            print(f'{name}: not installed, left out')
            continue
        rows.append({column: f'{value:.3g}' if isinstance(value, float) else value for column, value in row.items()})
        print(', '.join(f'{column} {value}' for column, value in rows[-1].items()), flush=True)
    if args.out:
        table = args.out / 'operator.csv'
        with replacing(table) as temporary, temporary.open('w', newline='', encoding='utf-8') as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator='\n')
            writer.writeheader()
            writer.writerows(rows)
        write_provenance(table)


if __name__ == '__main__':
    main()
