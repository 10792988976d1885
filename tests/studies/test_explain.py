"""The table of what explains a scan's error: rows in order, a drift that is known to be there explains most."""

import json
from dataclasses import replace

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.calibration.drift import Drift
from lingo_mi.geometry import circular
from lingo_mi.projectors import grid
from studies.explain import residuals as explain


def fan(views=60):
    """A fan beam whose panel drifts by two columns, of discs."""
    geometry = lm.Geometry.cone(
        DSO=400, DSD=600, nDetector=(1, 96), dDetector=2.0, nVoxel=(48, 48, 1), dVoxel=2.0, angles=circular(views)
    )
    x, y = np.meshgrid(*2 * [np.arange(48) - 23.5], indexing='ij')
    discs = sum((np.hypot(x - a, y - b) < r) * 0.02 for a, b, r in ((0, 0, 15), (6, 3, 4), (-5, -6, 3)))
    true = Drift.of(geometry, dict(u=1.0, u1=2.0)).panel(geometry).moved(geometry)
    scan = lm.Scan(geometry, grid.project_volume(discs[:, :, None].astype(np.float32), true))
    return lm.Dataset(scan.subset(slice(0, None, 2)), scan.subset(slice(1, None, 2)))


@pytest.mark.thorough
def test_a_drift_is_what_explains_it(tmp_path):
    dataset = fan()
    calibration = lm.calibrate(dataset, drift=3, progress=False)
    table = list(explain.rows(dataset, calibration, tmp_path, progress=lambda name: None))
    assert [row.name for row in table] == ['as given', 'axis and turn of the panel', 'drift', explain.NOTHING]
    assert table[1].rms < table[0].rms and table[2].rms < 0.6 * table[1].rms
    text = explain.report(table, tmp_path, 'corrected')
    assert text.count('\n') >= 5 and json.loads((tmp_path / 'rms.json').read_text())['drift'] == table[2].rms
    assert (tmp_path / 'residuals.png').stat().st_size > 1000 and (tmp_path / 'rms.provenance.json').exists()


def test_air_that_is_read_beside_the_object_is_a_row(tmp_path):
    """It is subtracted from held-out views, too, and not in an earlier row."""
    sound, air = fan(24), np.float32(0.1)
    dataset = lm.Dataset(*(lm.Scan(s.geometry, s.projections + air) for s in (sound.train, sound.test)))
    calibration = lm.calibrate(dataset, progress=False)
    assert calibration.air is not None
    rms = {row.name: row.rms for row in explain.rows(dataset, calibration, tmp_path, progress=lambda name: None)}
    assert list(rms) == ['as given', 'axis and turn of the panel', explain.AIR, explain.NOTHING]
    assert rms[explain.AIR] < 0.8 * rms['axis and turn of the panel']
    quiet = {r.name: r.rms for r in explain.rows(sound, replace(calibration, air=None), tmp_path, lambda name: None)}
    assert rms[explain.AIR] == pytest.approx(quiet['axis and turn of the panel'], rel=0.02)


@pytest.mark.thorough
def test_stored_rows_are_those_of_their_scan_and_numbers(tmp_path, monkeypatch):
    dataset = fan(24)
    calibration = lm.calibrate(dataset, progress=False)

    def rows(data=dataset):
        return list(explain.rows(data, calibration, tmp_path, progress=lambda name: None))

    first, judged = rows(), explain._judged
    computed = []
    monkeypatch.setattr(explain, '_judged', lambda name, *rest: computed.append(name) or judged(name, *rest))
    again = rows()
    assert not computed and [row.rms for row in again] == [row.rms for row in first]
    np.testing.assert_array_equal(again[1].view, first[1].view)
    (tmp_path / 'corrected' / 'as_given.json').write_text('{"rms": 1')  # cut off
    assert rows()[0].rms == first[0].rms and computed == ['as given']
    other = lm.Dataset(dataset.train, lm.Scan(dataset.test.geometry, 1.1 * dataset.test.projections))
    assert rows(other)[0].rms > first[0].rms and computed[1:] == [row.name for row in first]
    turned = lm.Scan(
        replace(dataset.train.geometry, angles=dataset.train.geometry.angles + 0.1), dataset.train.projections
    )
    computed.clear()
    assert rows(lm.Dataset(turned, dataset.test)) and computed[0] == 'as given'
    monkeypatch.setattr(explain, 'WITH_CLOUD', {'as given': {}})
    list(explain.cloud_rows(dataset, tmp_path, progress=lambda name: None, iterations=2, n_points=50))
    folders = {path.parent.name for path in tmp_path.rglob('as_given.json')}
    assert folders == {'corrected', 'with_the_cloud'}  # both have a row of this name
