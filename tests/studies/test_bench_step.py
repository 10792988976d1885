"""What a step of a fit is made of."""

import subprocess
import sys

import lingo_mi as lm
from helpers.script import FIT
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.studies.benchmarks.step import described, measured


def test_parts_of_a_step(tmp_path):
    """The parts make a whole, and each that computes takes time."""
    scan = dict(DSO=100, DSD=150, nDetector=24, dDetector=3, nVoxel=16, dVoxel=2)
    data = lm.simulate(
        lm.phantom('foot', size=16).data, lm.Geometry.cone(angles=lm.circular(6), **scan), progress=False
    )
    lm.fit(data, 'fast', n_points=200, iterations=20, progress=False, checkpoint=tmp_path / 'checkpoint.npz')
    found = measured(Fitted.from_checkpoint(tmp_path / 'checkpoint.npz'), 3)
    whole, densification = found.pop('a step'), found.pop('densification')
    assert abs(sum(found.values()) - whole) < 1e-9 and densification >= 0
    assert min(found['integrator, forward'], found['Adam'], whole) > 0
    assert 'A step takes 2.00 times' in described(
        {'integrator, forward': 0.004, 'integrator, backward': 0.006, 'a step': 0.02}
    )


def test_no_checkpoint(tmp_path):
    command = [sys.executable, '-m', 'lingo_mi.studies.benchmarks.step', tmp_path / 'nothing.npz']
    done = subprocess.run(command, capture_output=True, text=True, cwd=FIT.parents[1])
    assert done.returncode == 2 and done.stderr.startswith('error: ') and done.stderr.count('\n') == 1
