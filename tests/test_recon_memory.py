"""Peak memory of reconstructions: some volumes and sets of projections, never a matrix or a view's whole history."""
import subprocess
import sys
from pathlib import Path

import pytest

from lingo_mi.recon.memory import COPIES

# Not `resource`, whose maximum begins with that of the process which started this one.
pytestmark = pytest.mark.skipif(not Path('/proc/self/status').exists(), reason='asks Linux for its peak memory')

PROGRAM = """
import sys
import numpy as np
from lingo_mi.runtime import use_variant
use_variant('llvm_ad_mono')
import mitsuba as mi
from lingo_mi.geometry import Geometry, circular
from lingo_mi.recon.asd_pocs import asd_pocs
from lingo_mi.recon.cgls import cgls
from lingo_mi.recon.fdk import fdk
from lingo_mi.recon.refined import refined
from lingo_mi.recon.sart import sart
from lingo_mi.scan import Scan
from lingo_mi.xray.joseph import Joseph

def run(size, pixels, views):
    geometry = Geometry(1000., 1500., (pixels, pixels), 512 / pixels, (size,) * 3, 256 / size, circular(views))
    project = Joseph(geometry).forward(mi.Float(np.ones(size ** 3, np.float32)), np.arange(views))[0]
    scan = Scan(geometry, project.numpy().reshape(views, pixels, pixels).transpose(0, 2, 1))
    del project
    few, ramp = scan.subset(slice(0, None, 4)), np.linspace(0, 1, size ** 3, dtype=np.float32).reshape((size,) * 3)
    {'fdk': lambda: fdk(scan), 'sart': lambda: sart(scan, niter=1), 'cgls': lambda: cgls(scan, niter=1),
     'asd-pocs': lambda: asd_pocs(scan, niter=1, tviter=2),
     'refined': lambda: refined(few, 1, 1, 2, completed=scan, sample=lambda _: ramp)}[sys.argv[1]]()

def peak():
    return next(int(line.split()[1]) for line in open('/proc/self/status') if line.startswith('VmHWM'))

run(16, 24, 8)  # libraries and kernels
before = peak()
run(*map(int, sys.argv[2:]))
print(before, peak())
"""


@pytest.mark.parametrize('algorithm', ['fdk', 'sart', 'cgls', 'asd-pocs', 'refined'])
@pytest.mark.parametrize('size, pixels, views, share', [
    (128, 256, 64, 2), pytest.param(512, 1024, 100, 1.1, marks=pytest.mark.slow)])
def test_peak_memory(algorithm, size, pixels, views, share):
    """What `reconstruct.py` goes by: 512^3 voxels and 100 views of 1024^2 pixels within 8 GB. Small ones take up to twice that
    share, since Dr.Jit keeps some of what is freed."""
    out = subprocess.run([sys.executable, '-c', PROGRAM, algorithm, *map(str, (size, pixels, views))], capture_output=True,
                         text=True, check=True).stdout
    before, peak = (1024 * int(word) for word in out.split())
    copies = (peak - before) / (4 * (size ** 3 + views * pixels ** 2))
    print(f'{algorithm}: {peak / 1e9:.2f} GB, {copies:.2f} of the data')
    assert peak < 8e9 and copies < share * COPIES[algorithm]
