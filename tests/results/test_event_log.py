"""TensorBoard's events: read back record by record."""

import struct
import sys

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.results.event_log import EventLog

pytest.importorskip('tensorboardX')


@pytest.fixture(scope='module')
def data():
    scan = dict(DSO=100, DSD=150, nDetector=20, dDetector=3, nVoxel=16, dVoxel=2)
    angles = lm.circular(6)
    held_out = lm.Geometry.cone(angles=angles + 0.3, **scan)
    return lm.simulate(lm.phantom('foot', size=16).data, lm.Geometry.cone(angles=angles, **scan), held_out=held_out)


def records(folder):
    from tensorboardX.proto.event_pb2 import Event

    (path,) = folder.glob('events.out.*')
    content, at = path.read_bytes(), 0
    while at < len(content):
        (length,) = struct.unpack_from('<Q', content, at)
        event = Event()
        event.ParseFromString(content[at + 12 : at + 12 + length])
        yield event
        at += 16 + length


def test_numbers_and_pictures(data, tmp_path):
    result = lm.fit(data, 'fast', iterations=40, n_points=300, progress=False, log_dir=tmp_path / 'logs')
    scalars, images = {}, {}
    for event in records(tmp_path / 'logs'):
        for value in event.summary.value:
            if value.HasField('image'):
                images[value.tag] = value.image
            else:
                scalars.setdefault(value.tag, {})[event.step] = value.simple_value
    for entry in result.history:
        for name in ('loss', 'gaussians', 'psnr_2d', 'psnr_3d'):
            assert scalars[name][entry['iteration']] == pytest.approx(entry[name], rel=1e-5)
    assert len(images) == 4 and all(i.encoded_image_string.startswith(b'\x89PNG') for i in images.values())
    assert (images['views/rendered_measured'].height, images['views/rendered_measured'].width) == (20, 40)
    assert (images['slices/axial'].height, images['slices/axial'].width) == (16, 32)


def test_a_place_that_cannot_be_written(data, tmp_path):
    (tmp_path / 'file').write_text('')
    for place in (tmp_path / 'file', tmp_path / 'file' / 'logs'):
        with pytest.raises(lm.InputError, match='file'):
            lm.fit(data, 'fast', iterations=2, n_points=300, progress=False, log_dir=place)


def test_without_the_library(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'tensorboardX', None)
    with pytest.raises(lm.InputError, match='tensorboard'):
        lm.fit(data, 'fast', iterations=2, n_points=300, progress=False, log_dir=tmp_path)
    assert np.all([not p.name.startswith('events') for p in tmp_path.iterdir()])


def test_pictures_have_the_step_of_their_numbers(tmp_path):
    from types import SimpleNamespace

    log, fit = EventLog(tmp_path), SimpleNamespace(method=lm.R2(), data=None, views=None)
    fit.scan_volume = np.ones((4, 4, 4), np.float32)
    for step in 7, 5000:
        log.snapshot(fit)
        log.step(dict(iteration=step, loss=1.0), 5000)
    log.close(True)
    steps = {event.step for event in records(tmp_path) for value in event.summary.value if value.HasField('image')}
    assert steps == {7, 5000}
