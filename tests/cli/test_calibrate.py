"""`lingo-mi calibrate`: what it prints and writes, and bad input in one line."""

import sys

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.cli import calibrate
from lingo_mi.files.scans import history_of, read_scan, write_scan
from lingo_mi.geometry import circular


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, 'argv', ['lingo-mi calibrate', *map(str, arguments)])
    calibrate.main()


@pytest.fixture
def fan(tmp_path):
    """Three discs in one row, with the axis 2.5 columns off."""
    geometry = lm.Geometry.cone(
        DSO=400, DSD=600, nDetector=(1, 96), dDetector=2.0, nVoxel=(48, 48, 1), dVoxel=2.0, angles=circular(24)
    )
    x, y = np.meshgrid(*2 * [np.arange(48) - 23.5], indexing='ij')
    discs = sum((np.hypot(x - a, y - b) < r) * 0.02 for a, b, r in ((0, 0, 15), (6, 3, 4), (-5, -6, 3)))
    true = lm.simulate(discs[:, :, None].astype(np.float32), geometry, progress=False).train
    write_scan(tmp_path / 'scan.npy', lm.Scan(geometry, np.roll(true.projections, 2, 2)), 'npy')
    return tmp_path / 'scan.npy'


def test_the_axis_is_found_and_written(fan, monkeypatch, capsys):
    out = fan.with_name('corrected.npy')
    run(monkeypatch, fan, '--out', out)
    assert 'shift of the panel along u: -' in capsys.readouterr().out
    before, after = read_scan(fan).train, read_scan(out).train
    assert after.geometry.offDetector[1] == pytest.approx(-4.0, abs=0.2)
    np.testing.assert_array_equal(after.projections, before.projections)
    assert 'calibrated_from: scan.npy' in out.with_suffix('.yml').read_text()


def test_the_air_level_is_subtracted(fan, monkeypatch, capsys):
    """The air level is subtracted from a scan without frames, and the scanner stays as it was."""
    scan = read_scan(fan).train
    geometry = scan.geometry
    sound = np.roll(scan.projections, -2, 2)
    write_scan(fan, lm.Scan(geometry, sound + np.float32(0.05)), 'npy')
    run(monkeypatch, fan, '--out', fan.with_name('corrected.npy'))
    assert 'air beside the object: +0.05 on average' in capsys.readouterr().out
    np.testing.assert_allclose(read_scan(fan.with_name('corrected.npy')).train.projections, sound, atol=2e-3)


def test_history_is_kept_and_what_is_left_out_is_said(fan, monkeypatch, tmp_path):
    write_scan(fan, read_scan(fan).train, 'npy', dict(frames='raw.tif'))
    run(monkeypatch, fan, '--out', tmp_path / 'a.npy')
    assert history_of(tmp_path / 'a.npy')['before'] == dict(frames='raw.tif')
    scan = read_scan(fan).train
    write_scan(tmp_path / 'b.pickle', lm.Dataset(scan.subset(slice(0, 20)), scan.subset(slice(20, 24))), 'naf')
    with pytest.warns(UserWarning, match='the views to fit alone'):
        run(monkeypatch, tmp_path / 'b.pickle', '--out', tmp_path / 'c.npy')
    assert len(read_scan(tmp_path / 'c.npy').train) == 20


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (('--out', 'x.raw'), 'a name that ends in .npy'),
        (('--out', 'scan.npy', '--force'), 'would be overwritten'),
        (('--out', 'there.npy'), 'exists already'),
        (('--drift', '99'), 'degree of a polynomial'),
        (('--curve', '-1'), 'curve must be a whole number'),
    ],
)
def test_bad_input(fan, monkeypatch, arguments, message):
    monkeypatch.chdir(fan.parent)
    fan.with_name('there.npy').write_bytes(b'')
    before = fan.read_bytes()
    with pytest.raises(lm.InputError, match=message):
        run(monkeypatch, 'scan.npy', *arguments)
    assert fan.read_bytes() == before
