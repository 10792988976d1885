"""Objects in a notebook: the pixels that they hold, the right way up, with text as text."""

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

import lingo_mi as lm
from helpers.browser import browser, opened
from lingo_mi.common import notebook
from lingo_mi.files.volumes import read_volume, write_volume
from lingo_mi.geometry.grid import Grid
from lingo_mi.report.view import Page


def sprite(figure):
    text = re.search(r'base64,([^)]*)\)', figure)[1]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))))


def labels(figure):
    return re.search('data-labels="([^"]*)"', figure)[1].split('|')


def test_frames_are_the_images():
    images = np.arange(5 * 4 * 6, dtype=float).reshape(5, 4, 6)
    figure = notebook.frames(images, list('abcde'), 'title', 3, (0, 119))
    shown = sprite(figure).reshape(5, 4, 6)
    assert np.abs(shown / 255 - images / 119).max() < 1 / 255
    assert labels(figure) == list('abcde') and 'value="3"' in figure and '>d</output>' in figure


def test_many_and_large_images_are_thinned():
    images = np.random.default_rng(0).random((200, 500, 300)).astype(np.float32)
    figure = notebook.frames(images, [f'{i}' for i in range(200)], 't')
    assert len(labels(figure)) == notebook.MOST_FRAMES and sprite(figure).shape == (notebook.MOST_FRAMES * 167, 100)
    assert labels(figure)[0] == '0' and labels(figure)[-1] == '199'


def test_slices_stand_upright():
    """x to the right and y up in the axial slice, z up in the others; the slice with the most is seen first."""
    volume = np.zeros((8, 6, 4))
    volume[6, 1, 3] = 1
    axial, coronal, sagittal = notebook.slices(volume, (1, 2, 3), (10, 0, 0)).split('<figure')[1:]
    assert sprite(axial).reshape(4, 6, 8)[3, 4, 6] == 255 and 'z = 4.5 mm</output>' in axial
    assert sprite(coronal).reshape(6, 4, 8)[1, 0, 6] == 255 and 'y = -3 mm</output>' in coronal
    assert sprite(sagittal).reshape(8, 4, 6)[6, 0, 1] == 255 and 'x = 12.5 mm</output>' in sagittal


def test_text_is_text():
    figure = notebook.frames(np.zeros((2, 3, 3)), ['"><script>', '|x'], '<b>"')
    tags = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attrs: tags.append(tag)
    parser.feed(figure + notebook.table({'<i>': '<script>'}) + notebook.box('<u>'))
    assert not {'script', 'b', 'i', 'u'} & {*tags} and len(labels(figure)) == 2


GEOMETRIES = {
    'circle': dict(DSO=100, DSD=150, nDetector=8, dDetector=4, nVoxel=8, dVoxel=2, angles=[0.0, 1.0]),
    'tilted': dict(
        DSO=100, DSD=150, nDetector=8, dDetector=4, nVoxel=8, dVoxel=2, angles=[0.0, 1.0], rotDetector=(0.1, 0, 0)
    ),
}


@pytest.mark.parametrize('name', [*GEOMETRIES, 'parallel'])
def test_geometry(name):
    scan = GEOMETRIES.get(name)
    if scan is None:
        scan = dict(nDetector=8, dDetector=4, nVoxel=8, dVoxel=2, angles=[0.0, 1.0])
    geometry = (lm.Geometry.cone if name in GEOMETRIES else lm.Geometry.parallel)(**scan)
    shown = geometry._repr_html_()
    assert shown.count('<circle') == 4 and 'nan' not in shown  # two sources, from above and from the side
    assert '8 x 8 pixels of 4 x 4 mm' in shown and '8 x 8 x 8 voxels of 2 x 2 x 2 mm' in shown


def test_the_drawing_is_to_scale():
    """Source, axis and panel of the first view lie on a line, at DSO and DSD."""
    shown = lm.Geometry.cone(**GEOMETRIES['circle'] | dict(angles=[0.0]))._repr_html_()
    x = float(re.search('<circle cx="([^"]*)"', shown)[1])
    panel = float(
        re.search('stroke-width="3"', shown)
        and re.search(r'points="([^,]*),[^"]*" fill="none" stroke="#1a7f5a"', shown)[1]
    )
    box = [float(p.split(',')[0]) for p in re.search('<polygon points="([^"]*)"', shown)[1].split()]
    axis = (min(box) + max(box)) / 2
    assert (x - panel) / (x - axis) == pytest.approx(150 / 100, rel=0.01)
    assert (max(box) - min(box)) / (x - axis) == pytest.approx(16 / 100, rel=0.02)


def test_scan_dataset_and_volumes(tmp_path):
    geometry = lm.Geometry.cone(**GEOMETRIES['circle'])
    scan = lm.Scan(geometry, np.random.default_rng(0).random((2, 8, 8)))
    assert scan._repr_html_().count('type="range"') == 1 and '<svg' in scan._repr_html_()
    data = lm.Dataset(scan, scan, np.ones((8, 8, 8)))
    assert data._repr_html_().count('type="range"') == 5
    assert lm.Dataset(scan)._repr_html_().count('type="range"') == 1
    assert lm.phantom('foot', size=16)._repr_html_().count('type="range"') == 3
    assert lm.Reconstruction(np.zeros((8, 8, 8)), [], 1.0, geometry.grid)._repr_html_().count('type="range"') == 3
    write_volume(tmp_path / 'v.nii.gz', np.ones((4, 5, 1), np.float32), Grid((4, 5, 1), 1.0))
    assert read_volume(tmp_path / 'v.nii.gz')._repr_html_().count('<figure') == 1  # of a single slice


def test_a_slider_moves_the_picture(tmp_path):
    path = tmp_path / 'a.html'
    figure = notebook.frames(np.random.default_rng(0).random((5, 20, 20)), list('abcde'), 't')
    path.write_text(f'<!doctype html><html data-ready><body>{figure}')
    with browser() as chromium, opened(chromium, path.as_uri()) as page:
        page.focus('input')
        page.keyboard.press('ArrowRight')
        assert page.locator('output').text_content() == 'd'
        place = page.evaluate('getComputedStyle(document.querySelector("[role=img]")).backgroundPositionY')
        assert place == f'{-3 * notebook.SIDE}px'


def test_page(tmp_path):
    page = Page('<!doctype html><p title="a">"&</p>')
    path = page.save(tmp_path / 'deep' / 'a.html')
    assert path.read_text() == page.text
    with pytest.raises(lm.InputError, match='exists already'):
        page.save(path)
    assert page.save(path, force=True) == path
    assert 'srcdoc="&lt;!doctype html&gt;&lt;p title=&quot;a&quot;&gt;&quot;&amp;' in page._repr_html_()
