"""napari's widget: a fit grows in a layer, stops after Cancel, and says in one line what is wrong with a scan."""

import os
import time

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.files.scans import write_scan
from lingo_mi.geometry import circular

os.environ.setdefault('QT_QPA_PLATFORM', 'offscreen')
pytest.importorskip('napari', reason='needs napari')
pytest.importorskip('qtpy.QtWidgets', reason='needs a Qt binding', exc_type=ImportError)

from napari.layers import Image
from qtpy.QtWidgets import QApplication

from lingo_mi.napari.widget import FitWidget


class Viewer:
    """The part of a napari viewer that the widget uses."""

    def __init__(self):
        self.layers = []

    def add_image(self, data, **options):
        self.layers.append(Image(data, **options))
        return self.layers[-1]


@pytest.fixture(scope='module')
def scan(tmp_path_factory):
    path = tmp_path_factory.mktemp('scan') / 'scan.npy'
    phantom = lm.phantom('foot', size=16).data
    geometry = lm.Geometry.cone(angles=circular(6), DSO=100, DSD=150, nDetector=24, dDetector=3, nVoxel=16, dVoxel=2)
    write_scan(path, lm.simulate(phantom, geometry, progress=False).train, 'npy')
    return path


@pytest.fixture
def widget():
    QApplication.instance() or QApplication([])
    return FitWidget(Viewer())


def wait_for(condition, seconds=120):
    """Let Qt handle its events until the condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        QApplication.processEvents()
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_fit_grows_in_one_layer(widget, scan):
    widget.scan.value, widget.steps.value = scan, 200
    widget.fit()
    assert not widget.start.enabled and widget.cancel.enabled
    wait_for(lambda: widget._viewer.layers or widget.start.enabled)
    assert widget._viewer.layers, widget.status.value
    first = widget._viewer.layers[0].data.copy()
    wait_for(lambda: widget.start.enabled)
    assert widget.status.value == 'done' and not widget.cancel.enabled
    (layer,) = widget._viewer.layers
    assert layer.data.shape == first.shape and np.isfinite(layer.data).all()
    assert (layer.data != first).any()


def test_cancel_stops_the_fit(widget, scan):
    widget.scan.value, widget.steps.value = scan, 10_000
    widget.fit()
    wait_for(lambda: widget._viewer.layers or widget.start.enabled)
    assert widget._viewer.layers, widget.status.value
    widget.cancel.changed.emit(True)
    wait_for(lambda: widget.start.enabled)
    assert widget.status.value == 'cancelled'


def test_a_file_that_is_not_a_scan_is_one_line(widget, tmp_path):
    path = tmp_path / 'nothing.npy'
    path.write_bytes(b'')
    widget.scan.value = path
    widget.fit()
    wait_for(lambda: widget.start.enabled)
    assert 'nothing.npy' in widget.status.value and '\n' not in widget.status.value
    assert not widget._viewer.layers
