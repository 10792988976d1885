"""The stages of a fit, as functions of the size of everything; run as a program, it measures one of them.

    python -m studies.growth.stages step 64,128,16,10000    # voxels a side, pixels a side, views, Gaussians; more sizes

prints a line of JSON for every size: CPU seconds of a call (user and system), and the peak of memory in bytes, inputs included,
above what libraries and a tiny call take.
"""

from __future__ import annotations

import argparse
import gc
import json
import resource
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

TINY = 16, 16, 4, 100
AXES = 'voxels', 'pixels', 'views', 'Gaussians'
# Sizes that each stage's cost depends on; the others are skipped.
DEPENDS = {
    'initialise': AXES,
    'step': ('pixels', 'Gaussians'),
    'voxelise': ('voxels', 'Gaussians'),
    'FDK': ('voxels', 'pixels', 'views'),
    'SART, one pass': ('voxels', 'pixels', 'views'),
    'measure': ('voxels', 'pixels', 'views'),
    'save': ('voxels', 'Gaussians'),
}


@dataclass(frozen=True)
class Size:
    """voxels and pixels a side, views, Gaussians."""

    voxels: int
    pixels: int
    views: int
    gaussians: int


def prepare(stage: str, size: Size) -> Callable[[], object]:
    """A function that runs a stage once, with its inputs made."""
    return globals()[f'_{stage.partition(",")[0].lower()}'](size)


def _geometry(size: Size):
    from lingo_mi.geometry.base import Geometry

    return Geometry.cone(
        DSO=1000.0,
        DSD=1500.0,
        nDetector=(size.pixels, size.pixels),
        dDetector=512 / size.pixels,
        nVoxel=(size.voxels,) * 3,
        dVoxel=256 / size.voxels,
        angles=np.arange(size.views) * np.pi / size.views,
    )


def _scan(size: Size):
    """A ball with a texture: what is measured does not depend on it."""
    from lingo_mi.scan import Scan

    g = _geometry(size)
    v, u = np.meshgrid(*(np.linspace(-1, 1, size.pixels, dtype=np.float32),) * 2, indexing='ij')
    ball = 150 * np.sqrt(np.maximum(0, 0.3 - u * u - v * v)) * (1 + 0.1 * np.sin(40 * u) * np.sin(40 * v))
    return Scan(g, np.broadcast_to(ball.astype(np.float32), (size.views, size.pixels, size.pixels)).copy())


def _method(size: Size):
    from lingo_mi.fitting.methods.fast import Fast

    return Fast().changed(n_points=size.gaussians, values_per_gaussian=0)


def _state(size: Size):
    """A method, and a state as in the course of a fit: Gaussians fill half of the volume, two spacings a standard deviation."""
    from lingo_mi.fitting.start.start import StartingCloud

    rng = np.random.default_rng(0)
    n = size.gaussians
    points = rng.uniform(-0.8, 0.8, (n, 3)).astype(np.float32)
    cloud = StartingCloud(points, np.full(n, 0.3, np.float32), np.full(n, 0.6 * 1.6 / n ** (1 / 3), np.float32))
    method = _method(size).bounded(_scan(Size(size.voxels, size.pixels, 1, 1)))
    return method, method.starting_state(cloud, 1.0)


def _initialise(size: Size):
    scan, method = _scan(size), _method(size)
    return lambda: method.starting_cloud(scan)


def _step(size: Size):
    import drjit as dr

    from lingo_mi.fitting.device_state import DeviceState

    method, host = _state(size)
    stepper, state, rng = method.stepper(_scan(size)), DeviceState(host), np.random.default_rng(0)
    done = iter(range(10**9))

    def step():
        i = next(done)
        stepper.step(state, [i % size.views], i, rng)
        dr.sync_thread()

    step()
    step()  # all later steps have the second step's kernels
    return step


def _voxelise(size: Size):
    from lingo_mi.fitting.device_state import DeviceState

    method, host = _state(size)
    model = method.model(_geometry(size), 1.0)
    return lambda: model.volume(DeviceState(host))


def _fdk(size: Size):
    from lingo_mi.reconstruction import FDK, run_algorithm

    scan = _scan(size)
    return lambda: run_algorithm(scan, FDK())


def _sart(size: Size):
    from lingo_mi.reconstruction import SART, run_algorithm

    scan = _scan(size)
    return lambda: run_algorithm(scan, SART(niter=1))


def _measure(size: Size):
    from lingo_mi.metrics import quality as metrics

    rng, shape = np.random.default_rng(0), (size.voxels,) * 3
    truth = rng.random(shape, np.float32)
    volume, views = truth + np.float32(0.1), _scan(size).projections
    images = views + np.float32(0.1)

    def measure():
        metrics.compared(volume, truth)
        for function in (metrics.psnr_2d, metrics.ssim_2d, metrics.psnr_2d_r2, metrics.ssim_2d_r2):
            function(images, views)

    return measure


def _save(size: Size):
    """Volume, cloud and checkpoint; the report is drawn from what it needs, which does not grow with the scan."""
    from lingo_mi.files.ply import write_ply
    from lingo_mi.files.volumes import write_volume
    from lingo_mi.fitting.checkpoint import Checkpoint
    from lingo_mi.fitting.device_state import DeviceState

    (method, host), g = _state(size), _geometry(size)
    model = method.model(g, 1.0)
    checkpoint = Checkpoint(
        method,
        g,
        unit=1.0,
        state=host,
        arrays={},
        seed=0,
        rng={},
        iteration=0,
        seconds=0.0,
        history=[],
        info={},
        scan={},
        effects=False,
        search=None,
        seen=len(g),
    )
    volume = np.random.default_rng(0).random((size.voxels,) * 3, np.float32)

    def save():
        with tempfile.TemporaryDirectory() as folder:
            write_volume(Path(folder) / 'volume.nii.gz', volume, g.grid)
            write_ply(Path(folder) / 'gaussians.ply', *model.gaussians(DeviceState(host)))
            checkpoint.save(Path(folder) / 'fit.npz')

    return save


def _memory(name: str) -> int:
    """VmRSS, the memory of this process, or VmHWM, the largest since `_forget_peak`, bytes."""
    lines = Path('/proc/self/status').read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))


def _forget_peak() -> int:
    """Give back what nobody uses, and let the peak begin anew; the memory that is in use, bytes."""
    import drjit as dr

    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    Path('/proc/self/clear_refs').write_text('5')
    return _memory('VmRSS')


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def measure(stage: str, size: Size, least: float = 0.2) -> dict:
    """CPU seconds of a call, the second and later ones for `least` seconds unless the first takes ten times that; and the peak of
    memory, bytes."""
    before = _forget_peak()
    call = prepare(stage, size)
    began, calls = _cpu(), 0
    while calls < 2 and _cpu() - began < 10 * least or _cpu() - began < least:
        if calls == 1:  # the first has compiled the kernels of this size, which a long call does not notice
            began = _cpu()
        call()
        calls += 1
    return dict(seconds=(_cpu() - began) / max(calls - 1, 1), peak=_memory('VmHWM') - before)


def main() -> None:
    from lingo_mi.common.runtime import use_variant

    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('stage', choices=DEPENDS)
    p.add_argument('sizes', nargs='+', type=_size, metavar=','.join(AXES))
    args = p.parse_args()
    use_variant('llvm_ad_mono')
    prepare(args.stage, Size(*TINY))()
    for size in args.sizes:
        print(json.dumps(measure(args.stage, size)), flush=True)


def _size(text: str) -> Size:
    try:
        numbers = [int(number) for number in text.split(',')]
        if len(numbers) == len(AXES) and min(numbers) > 0:
            return Size(*numbers)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f'{text!r} is not four positive numbers, such as 64,128,16,10000')


if __name__ == '__main__':
    main()
