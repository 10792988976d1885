"""Frames from every kind of file: their counts come back, and what is damaged is named in one line."""

import struct
import sys

import numpy as np
import pytest
import yaml
from PIL import Image

import lingo_mi as lm
from helpers.raw_frames import check, load, raw_frames, save
from lingo_mi.common.errors import InputError
from lingo_mi.files import scans
from lingo_mi.files.volumes import read_volume
from lingo_mi.raw import frames
from lingo_mi.raw.frames import open_recording

tifffile = pytest.importorskip('tifffile')


def write_tiff_folder(folder, stack):
    folder.mkdir()
    for i, image in enumerate(stack):
        tifffile.imwrite(folder / f'a_{i}.tif', image)  # a_10 sorts after a_9


def test_tiff_folders(tmp_path, scan_yml):
    raw = raw_frames(n=12)
    scan_yml.write_text(scan_yml.read_text().replace('angles: [0, 60, 120, 180, 240, 300]', ''))
    values = yaml.safe_load(scan_yml.read_text())
    values['angles'] = list(range(0, 360, 30))
    scan_yml.write_text(yaml.safe_dump(values))
    for name in ('views', 'flats', 'darks'):
        write_tiff_folder(tmp_path / name, getattr(raw, name))
    check(load(tmp_path / 'views', scan_yml, flats=tmp_path / 'flats', darks=tmp_path / 'darks'), raw)


def test_tiff_stack(tmp_path, raw, scan_yml):
    for name in ('views', 'flats', 'darks'):
        tifffile.imwrite(tmp_path / f'{name}.tif', getattr(raw, name), photometric='minisblack')
    check(load(tmp_path / 'views.tif', scan_yml, flats=tmp_path / 'flats.tif', darks=tmp_path / 'darks.tif'), raw)


def test_edf_of_several_frames(tmp_path, raw, scan_yml):
    image = pytest.importorskip('fabio').edfimage.EdfImage(data=raw.views[0])
    for view in raw.views[1:]:
        image.append_frame(data=view)
    image.write(str(tmp_path / 'views.edf'))
    check(load(tmp_path / 'views.edf', scan_yml, **save(tmp_path, raw)), raw)


def test_edf(tmp_path, raw, scan_yml):
    edf = pytest.importorskip('fabio').edfimage.EdfImage
    (tmp_path / 'views').mkdir()
    for i, image in enumerate(raw.views):
        edf(data=image).write(str(tmp_path / 'views' / f'{i}.edf'))
    check(load(tmp_path / 'views', scan_yml, **save(tmp_path, raw)), raw)


@pytest.mark.parametrize(('suffix', 'dtype'), [('png', np.uint8), ('png', np.uint16), ('jp2', np.uint16)], ids=str)
def test_pictures(tmp_path, suffix, dtype):
    stack = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (11, 12, 9)).astype(dtype)
    for i, image in enumerate(stack):
        Image.fromarray(image).save(tmp_path / f'a{i}.{suffix}')
    views = open_recording(tmp_path).views
    assert (len(views), views.shape, views.dtype) == (11, (12, 9), dtype)
    np.testing.assert_array_equal([views[i] for i in range(11)], stack)
    (tmp_path / f'a3.{suffix}').write_bytes((tmp_path / f'a3.{suffix}').read_bytes()[:-40])
    with pytest.raises(InputError, match='a3'):
        open_recording(tmp_path).views[3]
    (tmp_path / f'a0.{suffix}').write_bytes(b'none')
    with pytest.raises(InputError, match=f'a0.{suffix}: is damaged '):
        open_recording(tmp_path)


@pytest.mark.parametrize('mode', ['RGB', 'P', 'LA', '1'])
def test_pictures_in_colours(tmp_path, mode):
    Image.new(mode, (9, 12)).save(tmp_path / 'a.png')
    with pytest.raises(InputError, match=f'a.png: holds {mode} pixels .*; write counts as 8 or 16 bits of grey'):
        open_recording(tmp_path)


def write_his(path, image):
    """Write Elekta's format: a header of 68 bytes with corners, count and type, 32 further bytes, then the counts."""
    header, n = bytearray(100), len(image)
    header[:4] = 0, 0x70, 68, 0
    struct.pack_into('<H', header, 10, 32)
    struct.pack_into('<5H', header, 12, 1, 1, n, n, 1)
    header[32] = 4
    path.write_bytes(bytes(header) + image.astype('<u2').tobytes())


@pytest.mark.thorough
def test_frames_that_rtk_reads(tmp_path):
    pytest.importorskip('itk')
    frames = np.random.default_rng(0).integers(0, 60_000, (11, 8, 8))
    for i, image in enumerate(frames):
        write_his(tmp_path / f'{i}.his', image)
    views = open_recording(tmp_path).views
    assert (len(views), views.shape, views.dtype) == (11, (8, 8), np.uint16)
    np.testing.assert_array_equal([views[i] for i in range(11)], frames)
    (tmp_path / '3.his').write_bytes((tmp_path / '3.his').read_bytes()[:90])
    with pytest.raises(InputError, match='3.his|frame 3'):
        open_recording(tmp_path).views[3]


def test_one_frame_is_no_recording(tmp_path):
    write_his(tmp_path / '0.his', np.zeros((8, 8)))
    with pytest.raises(InputError, match='give the folder'):
        open_recording(tmp_path / '0.his')


def test_what_rtk_needs(tmp_path, monkeypatch):
    write_his(tmp_path / '0.his', np.zeros((8, 8)))
    monkeypatch.setitem(sys.modules, 'itk', None)
    with pytest.raises(InputError, match="'.\\[reference\\]'"):
        open_recording(tmp_path)


@pytest.mark.parametrize('layout', ['dxchange', 'nxtomo'])
@pytest.mark.parametrize('unit', ['degree', 'rad'])
def test_hdf5(tmp_path, raw, scan_yml, layout, unit):
    h5py = pytest.importorskip('h5py')
    values = yaml.safe_load(scan_yml.read_text())
    del values['angles']
    scan_yml.write_text(yaml.safe_dump(values))
    angles = np.arange(0, 360, 60.0) + 7
    stored = np.radians(angles) if unit == 'rad' else angles
    path = tmp_path / 'tomo.h5'
    with h5py.File(path, 'w') as file:
        if layout == 'dxchange':
            for name, stack in (('data', raw.views), ('data_white', raw.flats), ('data_dark', raw.darks)):
                file[f'exchange/{name}'] = stack
            theta = file.create_dataset('exchange/theta', data=stored)
        else:
            file['entry/instrument/detector/data'] = np.concatenate([raw.darks, raw.flats, raw.views])
            file['entry/instrument/detector/image_key'] = (
                [2] * len(raw.darks) + [1] * len(raw.flats) + [0] * len(raw.views)
            )
            every = np.concatenate([np.zeros(len(raw.darks) + len(raw.flats)), stored])
            theta = file.create_dataset('entry/sample/rotation_angle', data=every)
        theta.attrs['units'] = unit
    scan = load(path, scan_yml)
    check(scan, raw)
    np.testing.assert_allclose(np.degrees(scan.geometry.angles), angles)


def test_frames_of_different_sizes(tmp_path, raw, scan_yml):
    write_tiff_folder(tmp_path / 'v', raw.views)
    tifffile.imwrite(tmp_path / 'v' / 'a_3.tif', raw.views[3, :-1])
    with pytest.raises(lm.InputError, match=r'a_3.tif: has the shape \(23, 40\), but a_0.tif has \(24, 40\)'):
        load(tmp_path / 'v', scan_yml, **save(tmp_path, raw))


def test_damaged_frame(tmp_path, raw, scan_yml):
    write_tiff_folder(tmp_path / 'v', raw.views)
    (tmp_path / 'v' / 'a_2.tif').write_bytes(b'II*\0broken')
    with pytest.raises(lm.InputError, match='a_2.tif: is damaged'):
        load(tmp_path / 'v', scan_yml, **save(tmp_path, raw))


@pytest.mark.parametrize('content', ['number', 'group', 'text', 'angles'])
def test_files_of_another_structure(tmp_path, scan_yml, content):
    """They give one line, whatever they hold in the place of frames."""
    h5py = pytest.importorskip('h5py')
    path = tmp_path / ('a.npy' if content == 'number' else 'a.h5')
    if content == 'number':
        np.save(path, np.float32(3))
    else:
        with h5py.File(path, 'w') as file:
            if content == 'group':
                file.create_group('exchange/data')
            else:
                file['exchange/data'] = np.ones((2, 3, 4)) if content == 'angles' else 'frames'
                file['exchange/theta'] = 'a, b'
    with pytest.raises(InputError, match='a.npy|a.h5') as caught:
        load(path, scan_yml, i0=1.0)
    assert '\n' not in str(caught.value)


def test_a_stack_of_one_page(tmp_path):
    """ImageJ writes stacks of more than 4 GB with a single page."""
    stack = np.random.default_rng(0).integers(100, 9000, (6, 8, 10)).astype(np.uint16)
    tifffile.imwrite(tmp_path / 'stack.tif', stack, truncate=True)
    views = open_recording(tmp_path / 'stack.tif').views
    assert len(views) == 6
    np.testing.assert_array_equal([views[i] for i in range(6)], stack)


def test_units_in_an_array_and_alignment_frames(tmp_path):
    h5py = pytest.importorskip('h5py')
    frames = np.arange(6 * 4 * 5, dtype=np.uint16).reshape(6, 4, 5)
    with h5py.File(tmp_path / 'scan.h5', 'w') as file:
        file['entry/instrument/detector/data'] = frames
        file['entry/instrument/detector/image_key'] = [0, 0, 0, 0, 0, 0]
        file['entry/instrument/detector/image_key_control'] = [0, 0, 0, 0, -1, -1]
        file['entry/sample/rotation_angle'] = np.radians([0, 90, 180, 270, 180, 0])
        file['entry/sample/rotation_angle'].attrs['units'] = np.array([b'rad'])
    recording = open_recording(tmp_path / 'scan.h5')
    assert len(recording.views) == 4
    np.testing.assert_allclose(recording.angles, [0, 90, 180, 270])


def test_colours_are_refused(tmp_path, scan_yml):
    tifffile.imwrite(tmp_path / 'rgb.tif', np.zeros((20, 30, 3), np.uint8), photometric='rgb')
    with pytest.raises(InputError, match='holds colours'):
        read_volume(tmp_path / 'rgb.tif')


@pytest.mark.parametrize('several', [False, True])
def test_a_cut_off_edf(tmp_path, raw, scan_yml, several):
    """It is refused, because fabio would fill up what is missing."""
    image = pytest.importorskip('fabio').edfimage.EdfImage(data=raw.views[0])
    if several:
        for frame in raw.views[1:]:
            image.append_frame(data=frame)
    (tmp_path / 'v').mkdir()
    path = tmp_path / 'v' / 'a.edf'
    image.write(str(path))
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(lm.InputError, match='a.edf: is cut off'):
        load(path if several else path.parent, scan_yml, **save(tmp_path, raw))


@pytest.mark.parametrize(('empty', 'message'), [('data_white', 'no flat frames; give flats=FILE'), ('data_dark', '')])
def test_dxchange_with_stacks_of_no_frames(tmp_path, raw, scan_yml, empty, message):
    with pytest.importorskip('h5py').File(tmp_path / 'a.h5', 'w') as file:
        for name, stack in dict(data=raw.views, data_white=raw.flats, data_dark=raw.darks).items():
            file[f'exchange/{name}'] = stack[:0] if name == empty else stack
    if message:
        with pytest.raises(lm.InputError, match=message):
            load(tmp_path / 'a.h5', scan_yml)
    else:
        assert len(load(tmp_path / 'a.h5', scan_yml)) == 6


@pytest.mark.parametrize('place', ['entry/instrument/detector/data', 'exchange/data'])
def test_frames_in_a_file_that_is_not_there(tmp_path, place):
    h5py = pytest.importorskip('h5py')
    path = tmp_path / 'scan.nxs'
    with h5py.File(path, 'w') as file:
        file.create_group(place.rpartition('/')[0])
        file[place] = h5py.ExternalLink('frames.h5', '/data')
    with pytest.raises(
        InputError, match=f'/{place} is a link to frames.h5, which is not there; put that file beside scan.nxs'
    ):
        open_recording(path)
    with h5py.File(tmp_path / 'frames.h5', 'w') as file:
        file['data'] = np.ones((4, 5, 6), np.uint16)
    assert open_recording(path).views.shape == (5, 6)


def test_kinds_of_frames_that_a_scan_is_not():
    """`read_scan`, in a package below, names `import` for what this one opens."""
    assert scans.FRAMES == {*frames.IMAGES, *frames.FILES} - {'.npy'}
