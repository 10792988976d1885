"""What a step of a fit is made of."""

import pytest

import lingo_mi as lm
from helpers.script import FIT, run
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


@pytest.mark.parametrize('args', [(), ('nothing.npz',), ('nothing.npz', '--repeats', 0)])
def test_bad_input(args):
    code, out, err = run(FIT.with_name('bench_step.py'), *args)
    assert code == 2 and err.startswith('error: ') and err.count('\n') == 1 and not out
