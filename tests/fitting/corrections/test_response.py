"""A response of the detector found together with the cloud: recovery, checkpoints, held-out views, and nothing when off."""

import json
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from helpers.fits import SHORT, assert_equal_states, geometry, stop_at, tiny_scan
from helpers.same import assert_same
from lingo_mi.calibration.drift import Drift
from lingo_mi.calibration.response.response import Response
from lingo_mi.common.errors import InputError
from lingo_mi.completion.prepare import prepare_completed, prepare_start
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.quality import psnr_2d
from lingo_mi.reconstruction import SART
from lingo_mi.scan import Dataset, Scan

LONG = SHORT.changed(iterations=600, densify_from=10**6, lambda_tv=0.0)


def true_views(views=8, every=360):
    """Line integrals up to 2."""
    g = geometry(views, angles=circular(views, every, start=10))
    p = tiny_scan(g).projections
    return Scan(g, p * np.float32(2 / p.max()))


def measured(ideal, **values):
    """Return the measurements of a detector with these numbers, [T, K] by part."""
    varies = {k: 'smooth' for k in values if k != 'curve'} | (dict(curve=2) if 'curve' in values else {})
    response = Response.of(ideal.geometry, highest=2.0, **varies)
    for part in response.parts:
        part.values[: len(values[part.name])] = values[part.name]
    return Scan(ideal.geometry, response.applied(ideal.projections, ideal.geometry)), response


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize(
    ('values', 'changes', 'within', 'better'),
    [
        (dict(air=[[0.05], [0.03]]), dict(fit_air='view'), dict(air_level=0.01), 0.7),
        (dict(gain=[[0], [0.06]]), dict(fit_gain='smooth'), dict(gain_percent=1), 1.0),
    ],
)
def test_what_the_detector_did_is_found(values, changes, within, better):
    """Eight views and 600 steps give an air level of 0.05 to 0.01 and gains of 4 % to 1 %, rms. The line integrals are better,
    too.

    With five seeds, the root mean square of the gains' errors was 0.3 to 0.7 %, and the largest error 0.6 to 1.9 %.
    """
    ideal = true_views()
    scan, true = measured(ideal, **values)
    off, on = (run(scan, LONG.changed(n=300, **options), seed=3) for options in ({}, changes))
    actual, expected = on.model.response.report(), true.report()
    for name, limit in within.items():
        assert rms(np.array(actual[name]) - expected[name]) < limit, name
        assert rms(expected[name]) > 3 * limit
    errors = [rms(f.render(ideal.geometry) - ideal.projections) for f in (off, on)]
    assert errors[1] < better * errors[0]


ALL = dict(fit_air='view', fit_gain='smooth', fit_pixels='one')


def test_offsets_of_pixels_are_found():
    """If the flats missed gains of 20 %, 8 views give most of each pixel's offset, and better line integrals."""
    ideal = true_views()
    offsets = np.random.default_rng(0).normal(0, 0.2, ideal.geometry.nDetector).astype(np.float32)
    scan = Scan(ideal.geometry, ideal.projections + offsets)
    off, on = (run(scan, LONG.changed(n=300, **options), seed=3) for options in ({}, dict(fit_pixels='one')))
    actual = on.model.response.parts[0].values.reshape(offsets.shape)
    assert rms(actual - offsets) < 0.6 * rms(offsets)
    errors = [rms(f.render(ideal.geometry) - ideal.projections) for f in (off, on)]
    assert errors[1] < errors[0]
    assert on.model.response.report()['pixel_offset_rms'] == pytest.approx([rms(actual)])


@pytest.mark.parametrize(('misfit', 'left'), [(0.005, 0.25), (0.1, 1.0)])
def test_offsets_as_sure_as_the_object(misfit, left):
    """If the object is known, most of each pixel's offset is found; if it is not, nothing is lost."""
    ideal, rng = true_views(), np.random.default_rng(0)
    offsets = rng.normal(0, 0.05, ideal.geometry.nDetector)
    expected = ideal.projections + rng.normal(0, misfit, ideal.projections.shape).astype(np.float32)
    response = Response.of(ideal.geometry, pixels='one')
    response.fit(expected, ideal.projections + offsets.astype(np.float32))
    assert rms(response.parts[0].values.reshape(offsets.shape) - offsets) < left * rms(offsets)


def test_what_is_smooth_across_the_panel_is_left_to_the_object():
    ideal = true_views(4)
    slope = np.linspace(-1, 1, ideal.geometry.nDetector[1], dtype=np.float32)
    response = Response.of(ideal.geometry, pixels='one')
    response.fit(ideal.projections, ideal.projections + slope)
    assert np.abs(response.parts[0].values.reshape(ideal.geometry.nDetector)[:, 8:-8]).max() < 1e-6


def test_checkpoints_keep_the_response(tmp_path, sums_in_order):
    scan, _ = measured(true_views(4), air=[[0.05], [0.03]])
    method = SHORT.changed(iterations=20, **ALL)
    whole = run(scan, method, seed=3, path=tmp_path / 'whole.npz')
    path = tmp_path / 'checkpoint.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, method, seed=3, progress=stop_at(9), path=path)
    again = run(scan, method, seed=3, path=path, resume=True)
    assert_equal_states(again.state, whole.state)
    loaded = Fit.load(tmp_path / 'whole.npz')
    for name, values in whole.model.response.arrays().items():
        np.testing.assert_array_equal(again.model.response.arrays()[name], values)
        np.testing.assert_array_equal(loaded.model.response.arrays()[name], values)
    assert all(part.values.any() for part in whole.model.response.parts[1:])


def test_dead_columns():
    """Every other column is dead: binned by two, no pixel of such a scan would be valid."""
    scan, _ = measured(true_views(4), air=[[0.05], [0.03]])
    valid = np.ones(scan.projections.shape, bool)
    valid[..., ::2] = False
    fitted = run(replace(scan, valid=valid), SHORT.changed(iterations=20, **ALL), seed=3)
    assert np.isfinite(fitted.render(scan.geometry)).all()


def test_held_out_views_and_files_know_the_response(tmp_path, no_report):
    """Held-out views are compared with what the detector would measure, and metrics.json says what was found."""
    scan, true = measured(true_views(8), air=[[0.05], [0.03]])
    fitted = run(scan, SHORT.changed(iterations=20), seed=3)
    of_response = run(scan, SHORT.changed(iterations=20, fit_air='smooth'), seed=3)
    response = of_response.model.response
    response.parts[0].values = true.parts[0].values.copy()
    rendered = of_response.render(scan.geometry)
    np.testing.assert_allclose(
        of_response.expected(scan.geometry), true.applied(rendered, scan.geometry), rtol=1e-6, atol=1e-6
    )
    assert_same(fitted.expected(scan.geometry), fitted.render(scan.geometry))
    of_response.with_data(Dataset(scan, scan)).save(tmp_path / 'fit')
    numbers = json.loads((tmp_path / 'fit' / 'metrics.json').read_text())
    assert numbers['response']['air_level'] == pytest.approx(true.report()['air_level'])
    assert numbers['psnr_2d'] == pytest.approx(psnr_2d(of_response.expected(scan.geometry), scan.projections), abs=1e-3)


def test_steps_are_the_same_kernels_with_and_without():
    scan = true_views(3)

    def kernels(**changes):
        method = SHORT.changed(iterations=6, densify_from=100, lambda_tv=0.0, **changes)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            dr.kernel_history_clear()
            run(scan, method, seed=3)
            return {k['hash'] for k in dr.kernel_history([dr.KernelType.JIT])}

    off, on = kernels(), kernels(**ALL)
    assert off <= on


@pytest.mark.thorough
def test_smooth_poses_hold_and_are_told_of_views_between():
    """Most of a drift of the panel of 1.6 pixels is found, and views in between get theirs."""
    g = geometry(16, angles=circular(16, 360, start=10))
    pixel = g.dDetector[1]
    drift = Drift.of(g, dict(u1=0.8 * pixel))
    every = Scan(g, tiny_scan(drift.panel(g).moved(g)).projections)
    train, test = every.subset(slice(0, None, 2)), every.subset(slice(1, None, 2))
    changes = dict(rate_pose=(2e-3, 2e-4))
    off, view, smooth = (
        run(train, LONG.changed(**options), seed=3) for options in ({}, changes, changes | dict(pose_motion='smooth'))
    )
    held_out = [rms(f.expected(test.geometry) - test.projections) for f in (off, view, smooth)]
    assert held_out[2] < 0.6 * held_out[0] and held_out[2] < held_out[1]
    assert np.linalg.matrix_rank(smooth.poses.shift, 1e-6) <= 3
    assert view.poses.between(train.geometry, test.geometry) is test.geometry


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        (dict(fit_air='sometimes'), "fit_air is 'off', 'smooth' or 'view'"),
        (dict(fit_pixels='view'), "fit_pixels is 'off' or 'one'"),
        (dict(pose_motion='wild'), "pose_motion is 'view' or 'smooth'"),
    ],
)
def test_bad_options(changes, message):
    with pytest.raises(InputError, match=message):
        SHORT.changed(**changes)


def test_volumes_from_a_result_are_made_without_the_response(tmp_path, no_report):
    """The response is undone in measured views: in Python, from the files of the result, and beside completed views."""
    scan, true = measured(true_views(8), air=[[0.05], [0.03]], gain=[[0], [0.06]])
    method = SHORT.changed(iterations=20, fit_air='smooth', fit_gain='smooth')
    fitted = run(scan, method, seed=3)
    for part, true_part in zip(fitted.model.response.parts, true.parts):
        part.values = true_part.values.copy()
    fitted.checkpoint.arrays |= fitted.model.response.arrays()
    fitted.save(tmp_path / 'fit')
    ideal = true.undone(scan.projections, scan.geometry)
    assert np.abs(ideal - scan.projections).max() > 0.05
    for each in fitted, Fit.load(tmp_path / 'fit' / 'result.xml'):
        prepared, _ = prepare_start(scan, each, SART())
        np.testing.assert_allclose(prepared.projections, ideal, atol=1e-5)
        completed, _ = prepare_completed(scan, each, 16, SART())
        np.testing.assert_allclose(completed.projections[: len(scan)], ideal, atol=1e-5)
