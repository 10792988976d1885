"""Nikon's .xtekct: its circle, its white level, and the sense of its columns."""

import os
from pathlib import Path

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.raw.nikon import read_numbers, read_xtekct

TEXT = """[XTekCT]
Name=test
DetectorPixelsX=8
DetectorPixelsY=6
DetectorPixelSizeX=0.2
DetectorPixelSizeY=0.2
SrcToObject=76
SrcToDetector=1120
CentreOfRotationTop={top}
CentreOfRotationBottom={top}
WhiteLevel=60000
Projections=4
InitialAngle=5
AngularStep=90
[Xrays]
XraykV=160
"""


@pytest.fixture
def xtekct(tmp_path):
    path = tmp_path / 'scan.xtekct'
    path.write_text(TEXT.format(top=0))
    return path


def test_scan(tmp_path, xtekct):
    """The white level stands for flats; columns are turned round, and so is a crop."""
    views = np.full((4, 6, 8), 60000 * np.exp(-1), np.float32)
    views[:, :, 0] = 60000 * np.exp(-2)
    np.save(tmp_path / 'v.npy', views)
    scan = lm.load_raw(tmp_path / 'v.npy', xtekct, progress=False)
    np.testing.assert_allclose(scan.projections[:, :, -1], 2, rtol=1e-5)
    np.testing.assert_allclose(scan.projections[:, :, :-1], 1, rtol=1e-5)
    np.testing.assert_allclose(np.degrees(scan.geometry.angles), [5, 95, 185, 275])
    part = lm.load_raw(tmp_path / 'v.npy', xtekct, progress=False, crop=(0, 6, 0, 3))
    assert part.projections[0, 0].tolist() == pytest.approx([1, 1, 2], rel=1e-5)
    np.testing.assert_allclose(part.geometry.rays().corner, (scan.geometry.rays().corner + 5 * scan.geometry.rays().u))


def test_binning_that_leaves_columns_over(tmp_path, xtekct):
    """If eight columns are binned by three, those that are left over do not count, wherever they stand in the frame."""
    p = np.random.default_rng(0).uniform(0, 2, (4, 6, 8)).astype(np.float32)  # in our order
    np.save(tmp_path / 'v.npy', 60000 * np.exp(-p[:, :, ::-1]))
    scan = lm.load_raw(tmp_path / 'v.npy', xtekct, progress=False, binning=3)
    mean = np.exp(-p[:, :, :6]).reshape(4, 2, 3, 2, 3).mean((2, 4))
    np.testing.assert_allclose(scan.projections, -np.log(mean), atol=1e-5)
    whole = lm.load_raw(tmp_path / 'v.npy', xtekct, progress=False).geometry
    np.testing.assert_allclose(scan.geometry.rays().corner, whole.rays().corner, atol=1e-9)


def test_centre_of_rotation(xtekct):
    """Millimetres on the panel become millimetres at the object."""
    xtekct.write_text(TEXT.format(top=1.12))
    assert read_xtekct(xtekct).scanner['COR'] == pytest.approx(0.076)


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('SrcToObject=76\n', '', 'SrcToObject is missing'),
        ('Projections=4', 'Projections=many', 'Projections must be a number'),
        ('[XTekCT]', '[Other]', 'no section'),
        ('[XTekCT]', 'XTekCT', 'not a .xtekct file'),
        ('SrcToObject=76', 'SrcToObject=7600', 'SrcToDetector >= SrcToObject'),
    ],
)
def test_damaged(xtekct, old, new, message):
    xtekct.write_text(xtekct.read_text().replace(old, new))
    with pytest.raises(lm.InputError, match=message) as caught:
        read_xtekct(xtekct)
    assert '\n' not in str(caught.value)


def test_angles(tmp_path):
    path = tmp_path / 'scan.ang'
    path.write_text('Proj\tAngle(deg)\n1:\t0.5\n2:\t1.5\n')
    assert read_numbers(path).tolist() == [0.5, 1.5]
    path.write_text('0.5\n1.5\n2.5')
    assert read_numbers(path).tolist() == [0.5, 1.5, 2.5]
    path.write_text('1 0.5 10:30:00\n2 1.5 late\n')
    assert read_numbers(path).tolist() == [0.5, 1.5]
    path.write_text('1 0.5\n2 lost\n')
    with pytest.raises(lm.InputError, match="line 2 has 'lost' instead of a number"):
        read_numbers(path)
    path.write_text('1,0\n2,90\n3,180\n')
    assert read_numbers(path).tolist() == [0, 90, 180]
    for text in ('0,0\n89,75\n179,5\n', '1;0,00\n2;89,75\n', '1:\t0,5\n'):
        path.write_text(text)
        with pytest.raises(lm.InputError, match='decimal commas; write decimal points'):
            read_numbers(path)
    path.write_text('none')
    with pytest.raises(lm.InputError, match='holds no numbers'):
        read_numbers(path)


@pytest.mark.skipif('LINGO_MI_DATA' not in os.environ, reason='needs LINGO_MI_DATA')
def test_a_scanners_own_file():
    recording = read_xtekct(Path(os.environ['LINGO_MI_DATA']) / 'nikon' / 'radiogram.xtekct')
    values = recording.scanner
    assert recording.white == 60000 and len(values['angles']) == 3142 and values['nDetector'] == [2000, 1500]
    assert values['angles'][-1] - values['angles'][0] == pytest.approx(360, abs=0.2)


def test_the_white_level_has_the_dark_signal_in_it(tmp_path, xtekct):
    views = np.full((4, 6, 8), 5000 + 55000 * np.exp(-1), np.float32)
    np.save(tmp_path / 'v.npy', views)
    np.save(tmp_path / 'd.npy', np.full((2, 6, 8), 5000, np.float32))
    scan = lm.load_raw(tmp_path / 'v.npy', xtekct, progress=False, darks=tmp_path / 'd.npy')
    np.testing.assert_allclose(scan.projections, 1, rtol=1e-5)


@pytest.mark.parametrize('number', ['1e300', '1e13', '0'])
def test_numbers_of_projections(xtekct, number):
    xtekct.write_text(xtekct.read_text().replace('Projections=4', f'Projections={number}'))
    with pytest.raises(lm.InputError, match='needs Projections from 1 to 100000'):
        read_xtekct(xtekct)
