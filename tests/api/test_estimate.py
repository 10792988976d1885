"""`lm.estimate`: the memory by which work is refused, the time from its first steps, and bad input."""

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.api import estimate as module
from lingo_mi.reconstruction.memory_needs import memory_needed

SCANNER = dict(DSO=100, DSD=150, nDetector=(24, 30), dDetector=2, nVoxel=20, dVoxel=1.2)


def geometry(**changes):
    return lm.Geometry.cone(**{**SCANNER, **changes}, angles=lm.circular(8))


@pytest.fixture(scope='module')
def scan():
    volume = np.zeros((20, 20, 20), np.float32)
    volume[6:14, 5:12, 8:15] = 0.02
    return lm.Scan(geometry(), lm.Projector(geometry())(volume))


@pytest.mark.parametrize('work', [lm.SART(), lm.FDK(), lm.Refined(finer=2), lm.Best()])
def test_memory_is_what_the_work_is_refused_by(work, scan, monkeypatch):
    estimate = lm.estimate(scan.geometry, work)
    fine = scan.geometry.on(work.grid(scan.geometry))
    assert estimate.memory == memory_needed(work.name, fine, 8) and estimate.fits and estimate.seconds is None
    assert lm.estimate(scan, work).memory == estimate.memory
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: estimate.memory - 1)
    monkeypatch.setattr(module, 'room', lambda: estimate.memory - 1)
    assert not lm.estimate(scan, work).fits and 'too much' in repr(lm.estimate(scan, work))
    start = np.zeros((20, 20, 20)) if isinstance(work, lm.Refined) else None
    with pytest.raises(lm.InputError, match='GiB of memory'):
        lm.reconstruct(scan, work, start=start, progress=False)


def test_memory_of_a_fit(scan, monkeypatch):
    estimate = lm.estimate(scan, 'fast')
    assert estimate.memory == lm.estimate(scan.geometry, lm.Fast()).memory == 4 * (3 * 20**3 + 2 * 8 * 24 * 30)
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: estimate.memory - 1)
    with pytest.raises(lm.InputError, match='GiB of memory'):
        lm.fit(scan, 'fast', progress=False)


def test_masks_count(scan):
    valid = np.ones(scan.projections.shape, bool)
    valid[0, 3, 4] = False
    masked = lm.Scan(scan.geometry, scan.projections, valid)
    assert lm.estimate(masked, lm.SART()).memory - lm.estimate(scan, lm.SART()).memory == 4 * scan.projections.size


@pytest.mark.parametrize('work', [lm.SART(niter=100_000), lm.Fast().changed(iterations=100_000, n_points=300)])
def test_a_trial_stops(work, scan):
    low, high = lm.estimate(scan, work, trial=0.01).seconds
    assert 0 < low < high


def test_short_work_is_its_own_trial(scan):
    estimate = lm.estimate(lm.Dataset(scan), lm.SIRT(niter=2), trial=1000)
    assert estimate.seconds[0] == estimate.seconds[1] > 0


def test_it_is_readable():
    text = repr(lm.Estimate(3 * 2**30, 8 * 2**30, (40.0, 300.0)))
    assert text == 'Estimate(memory: 3 GiB of 8 GiB; time: 40 s to 5 min)'
    assert repr(lm.Estimate(2.5 * 2**30, 2**30)) == 'Estimate(memory: 2.5 GiB of 1 GiB, too much; time: unknown)'


@pytest.mark.parametrize(
    'make, message',
    [
        (lambda scan: lm.estimate(None, 'fast'), 'scan must be a Scan or a Dataset or a Geometry'),
        (lambda scan: lm.estimate(scan, 3), 'work must be an algorithm'),
        (lambda scan: lm.estimate(scan, lm.SART), 'work must be an algorithm'),
        (lambda scan: lm.estimate(scan, 'faster'), 'faster'),
        (lambda scan: lm.estimate(scan, lm.SART(), trial=0), 'trial is a time in seconds'),
        (lambda scan: lm.estimate(scan, lm.SART(), trial='1'), 'trial is a time in seconds'),
        (lambda scan: lm.estimate(scan.geometry, lm.SART(), trial=1), 'give the scan'),
        (lambda scan: lm.estimate(scan, lm.Refined(), trial=1), 'leave out trial'),
    ],
)
def test_bad_input(make, message, scan):
    with pytest.raises(lm.InputError) as caught:
        make(scan)
    assert message in str(caught.value) and '\n' not in str(caught.value)
