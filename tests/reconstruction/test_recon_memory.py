"""Peak memory of reconstructions: some volumes and sets of projections, never a matrix or a view's whole history."""

import subprocess
import sys
from pathlib import Path

import pytest

from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.reconstruction import ALGORITHMS
from lingo_mi.reconstruction.memory_needs import NEEDS, memory_needed
from lingo_mi.reconstruction.run import room_needed

# Not `resource`, whose maximum begins with the maximum of the parent process.
pytestmark = pytest.mark.skipif(not Path('/proc/self/status').exists(), reason='asks Linux for its peak memory')

PROGRAM = """
import sys
import numpy as np
from lingo_mi.common.runtime import use_variant
use_variant('llvm_ad_mono')
import mitsuba as mi
from lingo_mi.geometry import CircularGeometry, Grid, circular
from lingo_mi.reconstruction import ALGORITHMS
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan
from lingo_mi.projectors.joseph import Joseph

def run(size, pixels, views, offset=0):
    geometry = CircularGeometry(
        DSO=1000., DSD=1500., nDetector=pixels, dDetector=512 / pixels, grid=Grid(size, 256 / size), angles=circular(views),
        offDetector=(0, offset),
    )
    project = Joseph(geometry).forward(mi.Float(np.ones(size ** 3, np.float32)), np.arange(views))[0]
    scan = Scan(geometry, project.numpy().reshape(views, pixels, pixels).transpose(0, 2, 1))
    del project
    few, ramp = scan.subset(slice(0, None, 4)), np.linspace(0, 1, size ** 3, dtype=np.float32).reshape((size,) * 3)
    few_steps = dict(niter=1, tviter=2)
    options = {'fdk': {}, 'asd-pocs': few_steps, 'refined': dict(completed_niter=1) | few_steps, 'best': dict(niter=1, finer=1)}
    options['pls'] = dict(niter=2, strength=1e-4)
    algorithm = ALGORITHMS[sys.argv[1]](**options.get(sys.argv[1], dict(niter=1)))
    if sys.argv[1] == 'refined':
        run_algorithm(few, algorithm, completed=scan, sample=lambda _: ramp)
    else:
        run_algorithm(scan, algorithm)

def peak():
    return next(int(line.split()[1]) for line in open('/proc/self/status') if line.startswith('VmHWM'))

run(16, 24, 8)  # libraries and kernels
before = peak()
run(*map(int, sys.argv[2:]))
print(before, peak())
"""


def scanned(size, pixels, views, *_):
    """The geometry that `PROGRAM` runs."""
    return CircularGeometry(
        DSO=1000.0,
        DSD=1500.0,
        nDetector=(pixels, pixels),
        dDetector=512 / pixels,
        angles=circular(views),
        grid=Grid((size,) * 3, 256 / size),
    )


def taken(algorithm, *sizes):
    """The peak without libraries and small kernels, over the expected one, and the whole peak in bytes."""
    out = subprocess.run(
        [sys.executable, '-c', PROGRAM, algorithm, *map(str, sizes)], capture_output=True, text=True, check=True
    ).stdout
    before, peak = (1024 * int(word) for word in out.split())
    how = ALGORITHMS[algorithm](**dict(finer=1) if algorithm == 'best' else {})
    expected = room_needed(scanned(*sizes), how, sizes[2])
    print(f'{algorithm} {sizes}: {peak / 1e9:.2f} GB, {(peak - before) / expected:.2f} of what is expected')
    return (peak - before) / expected, peak


@pytest.mark.thorough
@pytest.mark.parametrize('algorithm', NEEDS)
def test_peak_memory_of_small_scans(algorithm):
    """The estimate of `reconstruct.py` holds within a factor of two: Dr.Jit keeps some of the freed memory."""
    assert 0.7 < taken(algorithm, 192, 288, 12)[0] < 2


@pytest.mark.thorough
def test_fdk_of_an_offset_panel():
    """It is completed by columns that no view has seen, a few views at a time. On a busy machine Dr.Jit frees later, so the
    smaller of two runs counts."""
    assert 0.7 < min(taken('fdk', 96, 512, 100, 200)[0] for _ in range(2)) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize('algorithm', NEEDS)
@pytest.mark.parametrize(
    'sizes', [(400, 576, 12), (400, 128, 12), (96, 1024, 100)], ids=['voxels', 'wide pixels', 'pixels']
)
def test_peak_memory_of_one_kind(algorithm, sizes):
    assert 0.8 < taken(algorithm, *sizes)[0] < 1.1


@pytest.mark.slow
@pytest.mark.parametrize('algorithm', ['fdk', 'sart', 'cgls', 'asd-pocs', 'refined'])
def test_peak_memory_of_large_scans(algorithm):
    """512^3 voxels and 100 views of 1024^2 pixels stay within 8 GB."""
    share, peak = taken(algorithm, 512, 1024, 100)
    assert 0.8 < share < 1.3 and peak < 8e9


@pytest.mark.parametrize('algorithm', NEEDS)
def test_needs_are_counted_in_float32(algorithm):
    """Voxels and pixels need 4 bytes each, in a scan of many voxels or of many pixels."""
    need, voxels, pixels = NEEDS[algorithm], 4 * 300**3, 4 * 900**2
    assert memory_needed(algorithm, scanned(300, 900, 1), 1) == pytest.approx(
        need.volumes * voxels + min(need.projections, 2) * pixels
    )
    assert memory_needed(algorithm, scanned(20, 900, 99), 99) == pytest.approx(need.projections * 99 * pixels, rel=1e-3)
