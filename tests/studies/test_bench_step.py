"""The parts of a fit's step."""

import pytest

import lingo_mi as lm
from helpers.script import run
from studies.benchmarks.step import described, measured

pytestmark = pytest.mark.usefixtures('no_report')


def checkpoint(folder, method, **settings):
    """The checkpoint of a short fit of three views."""
    scan = dict(DSO=100, DSD=150, nDetector=24, dDetector=3, nVoxel=16, dVoxel=2, angles=lm.circular(3))
    data = lm.simulate(lm.phantom('foot', size=16).data, lm.Geometry.cone(**scan), progress=False)
    lm.fit(data, method, progress=False, folder=folder / 'fit', **settings)
    return folder / 'fit' / 'checkpoint.npz'


def test_parts_of_a_step(tmp_path):
    """The parts make a whole, and each that computes takes time."""
    parts = measured(lm.load_fit(checkpoint(tmp_path, 'fast', n_points=200, iterations=20)), 3)
    whole, densification = parts.pop('a step'), parts.pop('densification')
    assert abs(sum(parts.values()) - whole) < 1e-9 and densification >= 0
    assert min(parts['integrator, forward'], parts['Adam'], whole) > 0
    assert 'A step takes 2.00 times' in described(
        {'integrator, forward': 0.004, 'integrator, backward': 0.006, 'a step': 0.02}
    )


@pytest.mark.thorough
def test_a_loss_of_one_part(tmp_path):
    """It cannot be left out: a step would compare nothing."""
    alone = dict(lambda_l1=0, lambda_ssim=0, lambda_gradient=1, lambda_tv=0)
    parts = measured(lm.load_fit(checkpoint(tmp_path, 'fast', n_points=200, iterations=4, **alone)), 1)
    assert set(parts) == {'integrator, forward', 'integrator, backward', 'Adam', 'the rest', 'a step', 'densification'}


def test_another_kind_of_fit(tmp_path):
    path = checkpoint(tmp_path, '3dgs', n_points=50, iterations=2)
    code, _, err = run('studies.bench_step', path)
    assert code == 2 and 'composites opacities' in err and err.count('\n') == 1


@pytest.mark.parametrize('args', [(), ('nothing.npz',), ('nothing.npz', '--repeats', 0)])
def test_bad_input(args):
    code, out, err = run('studies.bench_step', *args)
    assert code == 2 and err.startswith('error: ') and err.count('\n') == 1 and not out
