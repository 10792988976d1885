"""Time reconstruction on voxels against RTK and diffct on the CPU: projector, transpose, FDK, one SART iteration.

    python scripts/bench_recon.py
    python scripts/bench_recon.py --size 256 --views 100 --json bench_recon.json

The Shepp-Logan phantom on SIZE^3 voxels, VIEWS views of SIZE x SIZE pixels over a full turn. In every repeat each operation
is run by each package in turn, on the same cores, from arrays in memory to an array in memory; medians are printed, the first
round, which compiles, is not counted. A ratio is a package's time over ours: above 1 it is slower. The deviation is the
relative RMS difference from our result, without the outermost voxels, whose outer halves RTK leaves out. It is not small
where methods differ: diffct projects voxels that are constant (Siddon), ours and RTK's interpolate (Joseph); RTK's SART
backprojects by interpolating the panel, ours by the matched transpose.

RTK comes with `pip install -e '.[reference]'`, diffct with `pip install diffct torch`; what is not installed is left out.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

from lingo_mi.cli.common import Parser
from lingo_mi.errors import InputError
from lingo_mi.runtime import use_variant

os.environ.setdefault('OMP_WAIT_POLICY', 'passive')  # idle threads of one package must not slow the next one's


def arguments():
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--size', type=int, default=256, metavar='N', help='voxels and pixels along a side (default: 256)')
    p.add_argument('--views', type=int, default=100, metavar='N', help='(default: 100)')
    p.add_argument('--repeats', type=int, default=5, metavar='N', help='rounds (default: 5)')
    p.add_argument('--json', type=Path, metavar='F', help='write the numbers there')
    return p.parse_args()


def ours(geometry, scan, volume):
    """Our operations by name: functions without arguments that give a NumPy array."""
    import drjit as dr
    import mitsuba as mi

    from lingo_mi.projectors.joseph import Joseph
    from lingo_mi.reconstruction.fdk import FDK
    from lingo_mi.reconstruction.sart import blocks, sweep
    from lingo_mi.reconstruction.system import System

    joseph, views = Joseph(geometry), np.arange(len(geometry))

    def project():
        x = mi.Float(volume.ravel())
        images = joseph.forward(x, views)[0].numpy()
        return images.reshape(len(views), *geometry.nDetector[::-1]).transpose(0, 2, 1)

    def transpose():
        return joseph.adjoint(joseph.images(scan.projections), views).numpy().reshape(geometry.nVoxel)

    def sart():
        system = System(scan)
        x = sweep(system, system.start(None), 1.0, blocks(geometry.angles, 1, 'ordered', None), True)
        dr.eval(x)
        return system.volume(x)

    return dict(projector=project, transpose=transpose, FDK=lambda: FDK().run(scan).volume, SART=sart)


def rtk(geometry, scan, volume, cores):
    """RTK's operations, or None where it is not installed."""
    try:
        import itk

        itk.RTK  # noqa: B018 - loads it
    except (ImportError, AttributeError):
        return None
    sys.path.insert(0, str(Path('tests').resolve()))
    from helpers import rtk as bridge

    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(cores)
    return dict(
        projector=lambda: bridge.project(volume, geometry, itk),
        transpose=lambda: bridge.backproject(scan, itk),
        FDK=lambda: bridge.reconstruct('FDK', scan, itk),
        SART=lambda: bridge.reconstruct(
            'SART', scan, itk, NumberOfIterations=1, NumberOfProjectionsPerSubset=1, Lambda=1.0, EnforcePositivity=True
        ),
    )


def diffct(geometry, scan, volume, cores):
    """diffct's operations (PyTorch backend), or None where it is not installed."""
    try:
        import torch
        from diffct import Projector, fdk
    except ImportError:
        return None
    torch.set_num_threads(cores)
    frames = geometry.rays()
    pixel, voxel = geometry.dDetector[::-1], geometry.dVoxel[::-1]
    place = [frames.source, frames.centre(geometry.nDetector), frames.u / pixel[0], frames.v / pixel[1]]
    trajectory = tuple(torch.tensor(np.ascontiguousarray(x), dtype=torch.float32) for x in place)
    shapes = dict(detector_spacing=pixel, voxel_spacing=voxel, backend='torch')
    projector = Projector(trajectory, geometry.nVoxel[::-1], geometry.nDetector[::-1], **shapes)

    def views():
        return torch.from_numpy(np.ascontiguousarray(scan.projections.transpose(0, 2, 1)))

    def project():
        found = projector.project(torch.from_numpy(np.ascontiguousarray(volume.transpose(2, 1, 0))))
        return found.numpy().transpose(0, 2, 1)

    def reconstruct():
        angles = torch.tensor(geometry.angles, dtype=torch.float32)
        return fdk(views(), trajectory, geometry.nVoxel[::-1], angles, **shapes).numpy().transpose(2, 1, 0)

    return dict(
        projector=project, transpose=lambda: projector.backproject(views()).numpy().transpose(2, 1, 0), FDK=reconstruct
    )


def compare(packages, repeats: int) -> dict:
    """Median seconds of every package and, of the others, ratio and deviation, by operation and package."""
    seconds, deviation = {}, {}
    for turn in range(repeats + 1):
        for operation, own in packages['ours'].items():
            for name, functions in packages.items():
                if operation not in functions:
                    continue
                begun = time.perf_counter()
                found = functions[operation]()
                if turn:
                    seconds.setdefault((operation, name), []).append(time.perf_counter() - begun)
                    continue
                if operation != 'projector':
                    found = found[1:-1, 1:-1, 1:-1]
                if name == 'ours':
                    reference = found.copy()
                else:
                    deviation[operation, name] = float(np.linalg.norm(found - reference) / np.linalg.norm(reference))
    out = {}
    for (operation, name), taken in seconds.items():
        entry = out.setdefault(operation, {})[name] = dict(seconds=float(np.median(taken)))
        if name != 'ours':
            entry |= dict(
                ratio=entry['seconds'] / out[operation]['ours']['seconds'], deviation=deviation[operation, name]
            )
    return out


def main():
    args = arguments()
    if min(args.size, args.views, args.repeats) < 1 or args.size < 8:
        raise InputError('--size must be at least 8, --views and --repeats at least 1')
    use_variant('llvm_ad_mono')
    import drjit as dr

    from lingo_mi import phantoms
    from lingo_mi.geometry.base import Geometry, circular
    from lingo_mi.scan import Scan

    cores = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count()
    dr.set_thread_count(cores)
    volume = phantoms.make('shepp_logan', args.size).data
    geometry = Geometry(
        1000.0, 1500.0, (args.size, args.size), 512 / args.size, volume.shape, 256 / args.size, circular(args.views)
    )
    empty = Scan(geometry, np.zeros((args.views, args.size, args.size), np.float32))
    scan = Scan(geometry, ours(geometry, empty, volume)['projector']())
    packages = dict(ours=ours(geometry, scan, volume))
    for name, make in (('RTK', rtk), ('diffct', diffct)):
        functions = make(geometry, scan, volume, cores)
        if functions is None:
            print(f'{name}: not installed, left out')
        else:
            packages[name] = functions
    result = compare(packages, args.repeats)
    print(
        f'{args.size}^3 voxels, {args.views} views of {args.size} x {args.size} pixels, {cores} cores, medians of '
        f'{args.repeats} repeats'
    )
    for operation, found in result.items():
        parts = [f'{operation:9} ours {found["ours"]["seconds"]:8.3f} s']
        parts += [
            f'{name} {x["seconds"]:8.3f} s, ratio {x["ratio"]:6.2f}, deviation {x["deviation"]:.2g}'
            for name, x in found.items()
            if name != 'ours'
        ]
        print('   '.join(parts))
    if args.json:
        args.json.write_text(
            json.dumps(
                dict(size=args.size, views=args.views, cores=cores, repeats=args.repeats, operations=result), indent=1
            )
            + '\n'
        )
