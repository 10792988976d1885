"""Zeiss' .txrm: frames, references, and the circle, from containers written by the OLE2 standard."""

import sys

import numpy as np
import pytest

import lingo_mi as lm
from helpers.ole2 import write_ole2
from helpers.raw_frames import raw_frames

pytest.importorskip('olefile', reason='olefile (the `formats` extra) is not installed')


def content(raw, kind=5, **changes):
    """Streams of a scan of `raw.views` by path."""
    n, rows, columns = raw.views.shape
    dtype = {5: '<u2', 10: '<f4'}[kind]
    out = {
        'ImageInfo/NoOfImages': np.uint32(n),
        'ImageInfo/ImageWidth': np.uint32(columns),
        'ImageInfo/ImageHeight': np.uint32(rows),
        'ImageInfo/DataType': np.uint32(kind),
        'ImageInfo/PixelSize': np.float32(20),
        'ImageInfo/Angles': np.linspace(-90, 60, n).astype('<f4'),
        'ImageInfo/StoRADistance': np.full(n, -30, '<f4'),
        'ImageInfo/DtoRADistance': np.full(n, 60, '<f4'),
        'ReferenceData/DataType': np.uint32(10),
        'ReferenceData/Image': (raw.flats.mean(0)).astype('<f4'),
    }
    out |= {f'ImageData{1 + i // 100}/Image{1 + i}': view.astype(dtype) for i, view in enumerate(raw.views)}
    out |= {name.replace('__', '/').replace('_', '-'): value for name, value in changes.items()}
    return {name: np.asarray(value).tobytes() for name, value in out.items() if value is not None}


def load(path, **options):
    return lm.load_raw(path, progress=False, **options)


@pytest.mark.parametrize('kind', [5, 10], ids=['uint16', 'float32'])
def test_scan(tmp_path, kind):
    """Line integrals come from the file's own reference. The panel is at the scintillator, with pixels of 3 x 20 um."""
    raw = raw_frames(noise=False)
    write_ole2(tmp_path / 'a.txrm', content(raw, kind))
    np.save(tmp_path / 'd.npy', raw.darks)
    scan = load(tmp_path / 'a.txrm', darks=tmp_path / 'd.npy')
    assert (scan.geometry.DSO, scan.geometry.DSD) == (30, 90)
    np.testing.assert_allclose(scan.geometry.dDetector, 0.06, rtol=1e-6)
    np.testing.assert_allclose(np.degrees(scan.geometry.angles), -np.linspace(-90, 60, 6), atol=1e-5)
    np.testing.assert_allclose(scan.projections[scan.valid], raw.truth[scan.valid], atol=5e-4)  # half a count in 2700
    assert scan.valid.mean() > 0.98


def test_more_than_a_hundred_frames_and_several_references(tmp_path):
    raw = raw_frames(n=203, shape=(6, 8))
    flats = {f'MultiReferenceData__Image{1 + k}': flat.astype('<f4') for k, flat in enumerate(raw.flats[:3])}
    none = dict(ReferenceData__DataType=None, ReferenceData__Image=None)
    write_ole2(tmp_path / 'a.txrm', content(raw, MultiReferenceData__DataType=np.uint32(10), **flats, **none))
    from lingo_mi.raw.frames import open_recording

    recording = open_recording(tmp_path / 'a.txrm')
    assert (len(recording.views), len(recording.flats)) == (203, 3)
    for i in (0, 99, 100, 202):
        np.testing.assert_array_equal(recording.views[i], raw.views[i])
    np.testing.assert_array_equal(recording.flats[2], raw.flats[2])


def test_shifts_move_the_panel(tmp_path):
    """Shifts are in pixels, x to the right and y down, and the centre's shift is for all views."""
    raw = raw_frames()
    x, y = np.arange(6, dtype='<f4'), np.full(6, 2, '<f4')
    shifts = {'alignment__x_shifts': x, 'alignment__y_shifts': y, 'ReconSettings__CenterShift': np.float32(1.5)}
    write_ole2(tmp_path / 'a.txrm', content(raw, **shifts))
    write_ole2(tmp_path / 'b.txrm', content(raw))
    moved, still = (load(tmp_path / f'{name}.txrm').geometry.rays() for name in 'ab')
    expected = still.corner + (x[:, None] + 1.5) * still.u + 2 * still.v
    np.testing.assert_allclose(moved.corner, expected, atol=1e-6)


def test_an_ultra_has_a_parallel_beam(tmp_path):
    write_ole2(tmp_path / 'a.txrm', content(raw_frames(), ConfigZonePlates__Name=np.uint32(1)))
    geometry = load(tmp_path / 'a.txrm').geometry
    assert geometry.mode == 'parallel' and geometry.dDetector[0] == pytest.approx(0.02)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (dict(ImageInfo__Angles=None), 'ImageInfo/Angles is missing; .*: geometry=FILE'),
        (dict(ImageInfo__Angles=np.zeros(5, '<f4')), 'ImageInfo/Angles is cut off'),
        (dict(ImageInfo__PixelSize=np.float32(np.nan)), 'ImageInfo/PixelSize holds no finite numbers'),
        (dict(ImageInfo__DataType=np.uint32(3)), r'DataType must be 5 \(uint16\) or 10'),
        (dict(ImageInfo__NoOfImages=np.uint32(2**31)), 'says 2147483648 frames of 24 x 40 pixels'),
        (dict(ImageInfo__NoOfImages=None), 'ImageInfo/NoOfImages is missing'),
        (dict(ImageInfo__StoRADistance=np.zeros(6, '<f4')), 'StoRADistance must not be zero'),
    ],
    ids=str,
)
def test_what_is_missing(tmp_path, change, message):
    write_ole2(tmp_path / 'a.txrm', content(raw_frames(), **change))
    with pytest.raises(lm.InputError, match=f'a.txrm: .*{message}'):
        load(tmp_path / 'a.txrm')


def test_damaged(tmp_path):
    path = tmp_path / 'a.txrm'
    write_ole2(path, content(raw_frames()))
    whole = path.read_bytes()
    for length in (0, 300, 600, len(whole) // 2, len(whole) - 600):
        path.write_bytes(whole[:length])
        with pytest.raises(lm.InputError, match='a.txrm'):
            load(path)


def test_what_it_needs(tmp_path, monkeypatch):
    write_ole2(tmp_path / 'a.txrm', content(raw_frames()))
    monkeypatch.setitem(sys.modules, 'olefile', None)
    with pytest.raises(lm.InputError, match=r"needs the package olefile: pip install '.\[formats\]'"):
        load(tmp_path / 'a.txrm')
