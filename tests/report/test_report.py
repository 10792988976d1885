"""The report: which way up its pictures are, what it says, and that it lacks nothing when data do."""

import base64
import hashlib
import re
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

from lingo_mi.common.errors import InputError
from lingo_mi.report import figures, planes
from lingo_mi.report.data import ReportData
from lingo_mi.report.numbers import headline
from lingo_mi.report.page import report_page, write_report

SHAPE, SPACING, CENTRE = (20, 16, 12), (1.0, 1.5, 2.0), (10.0, 0.0, -5.0)


def phantom(shape=SHAPE):
    """A dim block with one bright voxel block at large x, middling y and large z."""
    volume = np.zeros(shape)
    volume[3:17, 3:13, :] = 0.3
    volume[13:16, 8:10, shape[2] * 3 // 4 :] = 1.0
    return volume


def content(shape=SHAPE, **changes):
    rng = np.random.default_rng(0)
    truth = phantom(shape)
    views = rng.random((5, 10, 14))
    data = dict(
        title='Block <1>',
        volume=truth + rng.normal(0, 0.02, shape),
        truth=truth,
        spacing=SPACING,
        centre=CENTRE,
        views=views,
        views_truth=views + 0.1,
        views_angles=np.arange(5) * 30.0,
        pixel=(1.0, 2.0),
        cloud_centres=rng.normal(0, 4, (300, 3)) + CENTRE,
        cloud_density=rng.random(300),
        command='fit a > b',
        metrics=dict(
            psnr_3d=31.234,
            ssim_3d=0.9,
            psnr_2d=40.0,
            ipsd=float('nan'),
            ipsd_targets=0,
            gaussians=51234,
            iterations=3000,
            seconds_fit=12.34,
            method='lingo',
            variant='llvm_ad_mono',
            seed=7,
            views=25,
            versions={'mitsuba': '3.9.1'},
            note='extra',
            history=[
                dict(
                    iteration=i,
                    seconds=i / 10,
                    loss=1 / (1 + i),
                    psnr_2d=30.0 if i % 2 else None,
                    psnr_3d=float('nan'),
                    gaussians=100 + i,
                )
                for i in range(5)
            ],
        ),
    )
    return ReportData(**{**data, **changes})


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp('new') / 'deep'
    return folder, write_report(folder, content())


def drawn(draw, data, cmap='gray'):
    """The AxesImages that a section hands to imshow."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=(8, 8))
    draw(fig, data)
    return [i for ax in fig.axes for i in ax.images if i.get_cmap().name == cmap]


# ---- Orientation ---------------------------------------------------------------------------------


def test_plane_puts_each_axis_where_it_belongs():
    volume = np.arange(2 * 3 * 4).reshape(2, 3, 4)
    # [vertical, horizontal], lowest row first
    assert planes.plane(volume, 2, 1)[2, 0] == volume[0, 2, 1]  # axial: x right, y up
    assert planes.plane(volume, 1, 2)[3, 1] == volume[1, 2, 3]  # coronal: x right, z up
    assert planes.plane(volume, 0, 1)[3, 2] == volume[1, 2, 3]  # sagittal: y right, z up


def test_extents_in_mm():
    assert planes.plane_extent(SHAPE, SPACING, CENTRE, 2) == (0, 20, -12, 12)
    assert planes.plane_extent(SHAPE, SPACING, CENTRE, 1) == (0, 20, -17, 7)
    assert planes.plane_extent(SHAPE, SPACING, CENTRE, 0) == (-12, 12, -17, 7)


def test_bright_block_is_drawn_at_its_place_in_mm():
    """The millimetres at which the bright pixels appear on paper are read back from what imshow holds."""
    images = drawn(figures.draw_slices, content(volume=phantom(), truth=None))
    low = np.array(CENTRE) - np.array(SHAPE) * SPACING / 2
    block = low + np.array([14.5, 9, 10.5]) * SPACING
    assert len(images) == 3
    for image, axes in zip(images, ((0, 1), (0, 2), (1, 2))):
        assert image.origin == 'lower'
        array, (left, right, bottom, top) = np.asarray(image.get_array()), image.get_extent()
        row, column = np.argwhere(array == 1).mean(0) + 0.5
        rows, columns = array.shape
        place = left + (right - left) * column / columns, bottom + (top - bottom) * row / rows
        np.testing.assert_allclose(place, block[list(axes)])


def test_views_are_drawn_as_on_the_detector():
    views = np.zeros((1, 10, 14))
    views[0, 2, 11] = 1
    (image,) = drawn(figures.draw_views, content(views=views, views_truth=None, views_angles=[0.0]))
    assert image.origin == 'upper' and tuple(image.get_extent()) == (-14, 14, 5, -5)  # v grows downwards
    assert np.asarray(image.get_array())[2, 11] == 1


def test_slices_and_their_truth_share_one_grey_scale():
    images = drawn(figures.draw_slices, content())
    assert len(images) == 6 and len({i.get_clim() for i in images}) == 1
    for image in drawn(figures.draw_slices, content(), figures.DIFFERENCE):
        low, high = image.get_clim()
        assert low == -high
    low, high = drawn(figures.draw_slices, content(volume=phantom()), figures.DIFFERENCE)[0].get_clim()
    assert low < high  # a perfect reconstruction


def test_richest_slice():
    volume = np.zeros((5, 6, 20))
    volume[1, 2, 4:13] = 1
    assert [planes.richest(volume, axis) for axis in range(3)] == [1, 2, 8]
    assert planes.richest(-volume, 0) == 1
    assert planes.richest(np.zeros((5, 5, 5)), 0) == 2


# ---- Numbers -------------------------------------------------------------------------------------


def test_series_leaves_gaps_out():
    history = [
        dict(iteration=0, loss=None),
        dict(iteration=1, loss=0.5),
        dict(loss=3.0),
        dict(iteration=2, loss=np.nan),
    ]
    x, y = planes.series(history, 'iteration', 'loss')
    assert x.tolist() == [1] and y.tolist() == [0.5]
    assert [len(a) for a in planes.series([], 'seconds', 'loss')] == [0, 0]


def test_headline():
    assert headline(content().metrics) == (
        'PSNR 3D 31.23 dB   ·   SSIM 3D 0.9000   ·   PSNR 2D 40.00 dB   ·   51,234 Gaussians   ·   '
        '3,000 iterations   ·   fit 12.3 s'
    )
    assert headline({'psnr_3d': np.inf, 'psnr_2d': np.float32('nan'), 'ssim_3d': None}) == 'PSNR 3D ∞ dB'


# ---- Files ---------------------------------------------------------------------------------------


def test_files(written):
    from PIL import Image

    folder, page = written
    assert sorted(p.name for p in folder.iterdir()) == ['report.html', 'report.png']
    assert page == folder / 'report.html'
    with Image.open(folder / 'report.png') as image:
        assert image.width == 1900 and image.height > 800


def test_page_needs_nothing_else(written):
    """It has no address except of its own parts, and a policy that forbids all others."""
    text = written[1].read_text(encoding='utf-8')
    policy, rest = text.partition('Content-Security-Policy" content="')[2].split('">', 1)
    assert policy.startswith("default-src 'none'; script-src 'sha256-") and policy.endswith("connect-src 'none'")
    markup = re.sub(r'(?s)<(script|style)[^>]*>.*?</\1>', '', rest)
    assert re.findall(r'(?:src|href)\s*=\s*["\']?([^"\'>]*)', markup) == ['#main']
    assert 'http' not in markup and '<link' not in text and '@import' not in text


def test_policy_names_the_page_own_script(written):
    text = written[1].read_text(encoding='utf-8')
    (script,) = re.findall(r'(?s)<script>(.*?)</script>', text)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in text


def test_page_says_it_all(written):
    text = re.sub(r'(?s)<(script|style)[^>]*>.*?</\1>', '', written[1].read_text(encoding='utf-8'))
    for piece in (
        'Block &lt;1&gt;',
        'fit a &gt; b',
        '31.23 dB',
        '51,234',
        'llvm_ad_mono',
        'mitsuba 3.9.1',
        '20 x 16 x 12 voxels of 1 x 1.5 x 2 mm',
        '<th scope="row">note</th><td class="value">extra</td>',
        '<th scope="row">Seed</th><td class="value">7</td>',
    ):
        assert piece in text, piece
    assert 'nan' not in text and 'None' not in text and 'n/a' not in text


@pytest.mark.parametrize(
    'changes, images',
    [
        pytest.param(dict(truth=None, views_truth=None), 4, marks=pytest.mark.thorough),
        (dict(views=None, views_truth=None, cloud_centres=None, metrics={}), 1),
        pytest.param(
            dict(
                cloud_centres=np.zeros((0, 3)),
                cloud_density=np.zeros(0),
                metrics=dict(history=[dict(iteration=1, loss=None, psnr_2d=float('nan'))]),
            ),
            2,
            marks=pytest.mark.thorough,
        ),
        (
            dict(
                volume=np.zeros(SHAPE),
                truth=np.zeros(SHAPE),
                views=np.zeros((1, 4, 5)),
                views_truth=np.zeros((1, 4, 5)),
                views_angles=[10.0],
                cloud_centres=np.zeros((1, 3)),
                cloud_density=np.zeros(1),
                metrics=dict(history=[dict(iteration=1, loss=0.5)]),
            ),
            4,
        ),
    ],
    ids=['measured', 'volume-only', 'no-cloud-no-curve', 'blank-one-gaussian-one-entry'],
)
def test_what_is_missing_is_left_out(changes, images):
    data = content(**changes)
    assert len(figures.sections(data)) == images
    assert figures.overview(data, '', dpi=30).startswith(b'\x89PNG')
    assert '</html>' in report_page(data)


def test_volume_alone(tmp_path):
    page = write_report(tmp_path, ReportData('', {}, phantom(), SPACING))
    assert '"views"' not in page.read_text(encoding='utf-8').partition('id="known">')[2].partition('</script>')[0]


@pytest.mark.parametrize('compared', [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_fan_beam(compared):
    """The one slice is large, with its truth beside it, and views are lines."""
    shape = (20, 16, 1)
    views = np.random.default_rng(1).random((6, 1, 30))
    data = content(
        shape,
        views=views,
        views_angles=np.arange(6.0),
        **(dict(views_truth=views) if compared else dict(truth=None, views_truth=None)),
    )
    assert len(drawn(figures.draw_slices, data)) == 1 + compared
    assert drawn(figures.draw_views, data) == []
    assert len(figures.sections(data)) == 4 and figures.overview(data, '', dpi=30).startswith(b'\x89PNG')


@pytest.mark.parametrize(
    'changes, message',
    [
        (dict(truth=np.zeros((2, 2, 2))), 'truth of the report has the shape'),
        (dict(volume=np.zeros((4, 4)), truth=None), 'volume of the report has the shape'),
        (dict(volume=np.full(SHAPE, np.nan)), 'volume of the report contains NaN'),
        (dict(volume=np.zeros((0, 3, 3)), truth=None), 'volume of the report is empty'),
        (dict(views_angles=None), 'needs views_angles'),
        (dict(views_truth=np.zeros((1, 1, 1))), 'views_truth'),
        (dict(cloud_density=None), 'needs cloud_density'),
        (dict(spacing=(1.0, 1.0)), 'spacing'),
    ],
)
def test_bad_data(changes, message):
    with pytest.raises(InputError, match=message):
        content(**changes)


def test_import_leaves_matplotlib_alone():
    modules = 'lingo_mi.report.page, lingo_mi.metrics.quality, lingo_mi.common.progress'
    code = f"import sys, {modules}\nprint('matplotlib' in sys.modules)"
    out = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout
    assert out == 'False\n'


@pytest.mark.parametrize(('factor', 'unit'), [(1.0, '1/mm'), (10.0, "X3D's scale, 0 to 1")])
def test_densities_that_no_scanner_measures_have_no_unit(factor, unit, tmp_path):
    """Nor are their views measured."""
    data = content(truth=None, volume=factor * phantom())
    assert data.quantity == f'density [{unit}]' and data.cloud_unit == f'density at the centre [{unit}]'
    assert data.reference == ('Measured' if factor == 1 else 'Reference')
    page = report_page(data)
    assert unit in page and ('1/mm' in page) == (factor == 1)
    figures.draw_slices(figure := Figure(), data)
    assert f'density [{unit}]' in [axes.get_ylabel() for axes in figure.axes]
