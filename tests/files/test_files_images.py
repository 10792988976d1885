"""Single-channel EXR images."""

import numpy as np
import OpenEXR
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files import images
from lingo_mi.files.images import read_exr, write_exr

IMAGE = (np.arange(12).reshape(3, 4) / 7 - 0.5).astype(np.float32)


def refused(path, match):
    with pytest.raises(InputError, match=match) as caught:
        read_exr(path)
    assert '\n' not in str(caught.value) and str(path) in str(caught.value)


def write_channels(path, channels):
    OpenEXR.File(
        {'compression': OpenEXR.NO_COMPRESSION, 'type': OpenEXR.scanlineimage},
        {k: OpenEXR.Channel(v) for k, v in channels.items()},
    ).write(str(path))


def test_round_trip_is_exact(tmp_path):
    write_exr(tmp_path / 'a.exr', IMAGE)
    back = read_exr(tmp_path / 'a.exr')
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, IMAGE)
    assert [p.name for p in tmp_path.iterdir()] == ['a.exr']
    write_exr(tmp_path / 'a.exr', IMAGE.T[::2].astype(float))  # replaces; not contiguous, not float32
    np.testing.assert_array_equal(read_exr(tmp_path / 'a.exr'), IMAGE.T[::2])


@pytest.mark.parametrize('shape', [(1, 1), (1, 4096), (300, 1)])
def test_thin_images(tmp_path, shape):
    image = np.random.default_rng(0).random(shape, np.float32)
    write_exr(tmp_path / 'a.exr', image)
    np.testing.assert_array_equal(read_exr(tmp_path / 'a.exr'), image)


def test_memory_that_an_image_needs(tmp_path, monkeypatch):
    """It needs its pixels twice, 4 bytes each."""
    asked = []
    monkeypatch.setattr(images, 'require_room', lambda size, *_: asked.append(size))
    write_exr(tmp_path / 'a.exr', IMAGE)
    read_exr(tmp_path / 'a.exr')
    assert asked == [2 * 4 * 12]


def test_channels(tmp_path):
    path = tmp_path / 'a.exr'
    write_channels(path, {'D': IMAGE.astype(np.float16)})
    np.testing.assert_array_equal(read_exr(path), IMAGE.astype(np.float16))
    write_channels(path, {'A': IMAGE * 0, 'Y': IMAGE})
    np.testing.assert_array_equal(read_exr(path), IMAGE)
    write_channels(path, {'R': IMAGE, 'G': IMAGE, 'B': IMAGE})
    refused(path, 'has the channels')


def test_bad_files(tmp_path):
    path = tmp_path / 'a.exr'
    refused(path, 'no such file')
    refused(tmp_path, 'cannot be read')
    write_exr(path, IMAGE)
    raw = path.read_bytes()
    for content in (b'', b'hello', raw[:20], raw[: len(raw) // 2], raw[:-5]):
        path.write_bytes(content)
        refused(path, 'damaged')
    size = raw.index(b'\0', raw.index(b'\0', 8) + 1) + 1  # of the first attribute
    path.write_bytes(raw[:size] + (-4).to_bytes(4, 'little', signed=True) + raw[size + 4 :])
    refused(path, 'an attribute has no end')
    write_channels(path, {'Y': IMAGE * np.float32('nan')})
    refused(path, 'NaN')


def test_write_refuses(tmp_path):
    for image, match in (
        (IMAGE[0], '2 dimensions'),
        (IMAGE[:0], 'non-empty'),
        (IMAGE * np.nan, 'NaN'),
        (np.array([['a']]), 'real numbers'),
    ):
        with pytest.raises(InputError, match=match):
            write_exr(tmp_path / 'a.exr', image)
    with pytest.raises(InputError, match='cannot be written'):
        write_exr(tmp_path / 'none' / 'a.exr', IMAGE)
    assert not list(tmp_path.iterdir())
