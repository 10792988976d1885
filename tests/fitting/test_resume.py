"""Fits that go on from a checkpoint: to the bit as without the interruption, and not from one of another fit."""

import errno
import os
from dataclasses import replace

import numpy as np
import pytest

from helpers.fits import SHORT, assert_equal_states, geometry, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run


@pytest.mark.parametrize('stop', [13, 12])
def test_resumed_fit_is_the_same_fit(scan, whole, tmp_path, stop, sums_in_order):
    """It is stopped between densifications, or right after one."""
    path = tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, SHORT, seed=3, path=path, progress=stop_at(stop))
    fitted = run(scan, SHORT, seed=3, path=path, resume=True)
    assert_equal_states(fitted.state, whole.state)
    assert [h['iteration'] for h in fitted.history] == [h['iteration'] for h in whole.history]
    np.testing.assert_array_equal(fitted.checkpoint.arrays['initial'], whole.checkpoint.arrays['initial'])


def test_other_projections_of_the_same_mean_are_refused(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    method = SHORT.changed(iterations=3)
    run(scan, method, path=path)
    nearly = replace(scan, projections=scan.projections * np.float32(1 + 1e-6))  # as simulated by another machine
    run(nearly, method, path=path, resume=True)
    for axis in range(3):
        mirrored = replace(scan, projections=np.flip(scan.projections, axis))
        with pytest.raises(InputError, match='other values of the projections'):
            run(mirrored, method, path=path, resume=True)


def test_resuming_a_finished_fit_changes_nothing(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    method = SHORT.changed(iterations=3)
    done = run(scan, method, path=path)
    assert_equal_states(run(scan, method, path=path, resume=True).state, done.state)


@pytest.mark.parametrize('change', [dict(extent=4.0), dict(iterations=40), dict(rate_scale=(1e-2, 1e-3))])
def test_checkpoint_of_other_options_is_refused(scan, stored, change):
    with pytest.raises(InputError, match=next(iter(change))):
        run(scan, SHORT.changed(iterations=2).changed(**change), path=stored, resume=True)


def test_checkpoint_of_another_scan_is_refused(scan, stored):
    g, method = scan.geometry, SHORT.changed(iterations=2)
    for other, what in (
        (scan.subset([0, 1]), 'views'),
        (replace(scan, geometry=replace(g, DSO=g.DSO * 0.9)), 'the geometry'),
        (replace(scan, projections=scan.projections * np.float32(1.01)), 'the projections'),
    ):
        with pytest.raises(InputError, match=f'other values of .*{what};'):
            run(other, method, path=stored, resume=True)
    almost = replace(scan, projections=scan.projections * np.float32(1 + 1e-6))  # simulated on another machine
    run(almost, method, path=stored, resume=True)


def test_a_full_disk_leaves_the_earlier_checkpoint(scan, stored, monkeypatch):
    before = stored.read_bytes()

    def savez(file, **_):
        file.write(b'begun')
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, 'savez', savez)
    with pytest.raises(InputError, match='fit.npz: cannot be written'):
        run(scan, SHORT.changed(iterations=2), path=stored, resume=True)
    assert stored.read_bytes() == before and [p.name for p in stored.parent.iterdir()] == [stored.name]


@pytest.mark.parametrize('share', [0, 0.3, 0.95])
def test_truncated_checkpoint_is_refused(scan, stored, share):
    content = stored.read_bytes()
    stored.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InputError, match='not a checkpoint'):
        run(scan, SHORT.changed(iterations=2), path=stored, resume=True)


def test_damaged_checkpoint_is_refused(scan, stored):
    content = bytearray(stored.read_bytes())
    content[len(content) // 3] ^= 0xFF
    stored.write_bytes(bytes(content))
    with pytest.raises(InputError, match='not a checkpoint'):
        run(scan, SHORT.changed(iterations=2), path=stored, resume=True)


def test_absent_checkpoint_is_refused(scan, tmp_path):
    with pytest.raises(InputError, match='no checkpoint'):
        run(scan, SHORT, path=tmp_path / 'fit.npz', resume=True)


def test_what_updates_something_in_shares_of_its_steps_is_not_made_longer(tmp_path):
    """For a fit with a gain of the views, half of a longer fit is another fit."""
    scan, path = tiny_scan(geometry()), tmp_path / 'checkpoint.npz'
    method = SHORT.changed(iterations=2, decay_steps=100, fit_gain='view')
    run(scan, method, path=path)
    with pytest.raises(InputError, match='other values of iterations'):
        run(scan, method.changed(iterations=4), path=path, resume=True)
    assert SHORT.changed(decay_steps=100).extensible and not method.extensible


def test_steps_of_an_unfinished_fit(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, SHORT, path=path, progress=stop_at(5))
    assert Fit.load(path).steps == 5
    assert run(scan, SHORT, path=path, resume=True).steps == Fit.load(path).steps == 30


@pytest.mark.parametrize('what', ['valid pixels', 'effects of the scan'])
def test_another_mask_or_other_effects_are_refused(scan, tmp_path, what):
    path, method = tmp_path / 'fit.npz', SHORT.changed(iterations=3)
    valid = np.ones(scan.projections.shape, bool)
    valid[0, :4] = False
    detector = Detector.of(**Detector.DEFAULTS | dict(photons=1e4))
    change = dict(valid=valid) if what == 'valid pixels' else dict(effects=Effects(detector=detector))
    run(replace(scan, **change), method, path=path)
    run(replace(scan, **change), method, path=path, resume=True)
    with pytest.raises(InputError, match=f'other values of .*the {what};'):
        run(scan, method, path=path, resume=True)
