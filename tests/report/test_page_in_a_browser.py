"""The page of a report in a real browser: what it shows is what it was given, and all of it is reached by keys."""

import re

import numpy as np
import pytest

from helpers.browser import CONTRAST, browser, opened, readout
from lingo_mi.geometry import Geometry, circular
from lingo_mi.report.data import ReportData
from lingo_mi.report.page import report_page, write_report
from lingo_mi.report.view import Page

SHAPE, SPACING, CENTRE = (24, 20, 16), (1.0, 1.5, 2.0), (10.0, 0.0, -5.0)
MARKUP = '</script><img src=x onerror=alert(1)><b>$title'


def content(**changes):
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing='ij'))
    truth = np.where((grid**2).sum(0) < 0.7, 0.1 + 0.02 * np.sin(9 * grid).sum(0), 0)
    views = rng.random((7, 12, 18)) * 3
    scan = dict(DSO=100, DSD=150, nDetector=(12, 18), dDetector=4, nVoxel=SHAPE, dVoxel=SPACING, offOrigin=CENTRE)
    history = [
        dict(iteration=i, seconds=i / 7, loss=1 / (1 + i), psnr_2d=20.0 + i, psnr_3d=10.0 + i, gaussians=100 + i)
        for i in (1, 2, 5, 9)
    ]
    fields = dict(
        title=MARKUP,
        volume=truth + rng.normal(0, 0.01, SHAPE),
        truth=truth,
        spacing=SPACING,
        centre=CENTRE,
        views=views,
        views_truth=views + rng.normal(0, 0.1, views.shape),
        views_angles=np.array([30.0, 0, 10, 20, 60, 50, 40]),
        pixel=(4.0, 4.0),
        cloud_centres=rng.normal(0, 4, (300, 3)) + CENTRE,
        cloud_density=rng.random(300),
        cloud_scales=rng.random((300, 3)) + 0.1,
        cloud_quaternions=rng.normal(0, 1, (300, 4)),
        scanner=Geometry.cone(angles=circular(9), **scan),
        command=f'fit {MARKUP}',
        metrics=dict(
            psnr_3d=31.234,
            psnr_2d=40.0,
            gaussians=300,
            iterations=9,
            method='fast',
            history=history,
            residual_by_view=[1.0, 2, 3, 4, 5, 6, 7],
        ),
    )
    return ReportData(**{**fields, **changes})


@pytest.fixture(scope='module')
def data():
    return content()


@pytest.fixture(scope='module')
def address(data, tmp_path_factory):
    return write_report(tmp_path_factory.mktemp('page'), data).as_uri()


@pytest.fixture(scope='module')
def chromium():
    with browser() as started:
        yield started


@pytest.fixture
def page(chromium, address):
    with opened(chromium, address) as opened_page:
        yield opened_page


def at(page):
    return tuple(int(i) for i in readout(page)['voxel'].split(', '))


def settled(page):
    page.evaluate('() => new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))')


def press(page, *keys):
    for key in keys:
        page.keyboard.press(key)
    settled(page)


def test_it_opens_from_disk_and_asks_for_nothing(page, address):
    assert page.addresses == [address]
    for part in ('slices', 'views', 'space', 'curves'):
        assert page.locator(f'#{part}').is_visible(), part
    assert page.title() == MARKUP and page.locator('h1').text_content() == MARKUP
    assert page.locator('pre').text_content() == f'fit {MARKUP}' and page.locator('img:not(.still)').count() == 0


def test_a_part_that_cannot_be_shown_leaves_the_others_alone(chromium, address):
    with opened(chromium, address, first='IntersectionObserver = undefined') as page:
        assert page.locator('#space').text_content().startswith('In spaceThis part could not be shown: ')
        assert page.locator('#slices canvas.picture').count() == 3 and page.locator('#curves .chart').count() == 3
        assert [message.split(':')[0] for message in page.messages] == ['space could not be shown']
        page.messages.clear()


WITHOUT_WEBGL = """const { getContext } = HTMLCanvasElement.prototype;
HTMLCanvasElement.prototype.getContext = function (kind, ...given) {
  return kind.startsWith('webgl') ? null : getContext.call(this, kind, ...given);
};"""


def test_a_browser_without_webgl(chromium, address):
    with opened(chromium, address, first=WITHOUT_WEBGL) as page:
        page.locator('#space').scroll_into_view_if_needed()
        page.locator('#space', has_text='This browser has no WebGL').wait_for()
        assert page.locator('#slices canvas.picture').count() == 3
        page.messages.clear()  # three.js says it too


def test_a_script_that_is_not_its_own_is_refused(chromium, data, tmp_path):
    """The page's policy holds even where markup would come through."""
    path = write_report(tmp_path, data)
    text = path.read_text(encoding='utf-8')
    path.write_text(text.replace('<main id="main">', '<main id="main"><script>document.title="run"</script>'))
    context = chromium.new_context(offline=True)
    page = context.new_page()
    page.goto(path.as_uri())
    page.wait_for_selector('html[data-ready]')
    assert page.title() == MARKUP
    context.close()


def test_values_at_the_crosshair_are_those_of_the_volume(page, data):
    """At voxels that keys reach, they are right to half the step that the page states, and to the digits that it shows."""
    step = float(re.search(r'steps of (\S+)\. ', page.locator('#slices .note').first.text_content())[1])
    assert step < 1e-5  # of values up to 0.2
    page.focus('[data-axis="2"]')
    for keys in ([], ['PageUp', 'ArrowLeft'], ['ArrowUp', 'ArrowUp', 'ArrowUp'], ['Home', 'Shift+PageUp']):
        press(page, *keys)
        shown, index = readout(page), at(page)
        for name, volume in (('Reconstruction', data.volume), ('Truth', data.truth)):
            assert abs(float(shown[name]) - volume[index]) <= step
        assert abs(float(shown['Difference']) - (data.volume - data.truth)[index]) <= 2 * step
        place = [CENTRE[a] + (index[a] + 0.5 - SHAPE[a] / 2) * SPACING[a] for a in range(3)]
        np.testing.assert_allclose([float(shown[f'{a} [mm]']) for a in 'xyz'], place, atol=0.051)


def test_keys_and_wheel_change_the_slice(page):
    start = at(page)
    for axis in (2, 1, 0):
        page.focus(f'[data-axis="{axis}"]')
        before = np.array(at(page))
        press(page, 'PageDown')
        assert (np.array(at(page)) - before == -np.eye(3, dtype=int)[axis]).all()
        page.hover(f'[data-axis="{axis}"]')
        page.mouse.wheel(0, -100)
        settled(page)
        assert (np.array(at(page)) == before).all()
    press(page, 'Home')
    assert at(page) == (0, *start[1:])
    press(page, 'End', 'End')
    assert at(page) == (SHAPE[0] - 1, *start[1:])


def test_a_pixel_of_the_slice_is_the_voxel_below_the_pointer(page, data):
    """The picture is the right way up: x to the right and y up, read from the canvas and from the pointer's row."""
    box = page.locator('[data-axis="2"]').bounding_box()
    z = at(page)[2]
    for i, j in ((3, 5), (20, 5), (11, 17)):
        x, y = box['x'] + box['width'] * (i + 0.5) / SHAPE[0], box['y'] + box['height'] * (1 - (j + 0.5) / SHAPE[1])
        page.mouse.move(x, y)
        settled(page)
        shown = readout(page, 'pointer')
        assert shown['voxel'] == f'{i}, {j}, {z}'
        assert abs(float(shown['Truth']) - data.truth[i, j, z]) < 1e-5
        grey = page.evaluate(
            """([x, y]) => {
              const c = document.querySelector('[data-axis="2"]');
              const b = c.getBoundingClientRect();
              const place = [((x - b.left) * c.width) / b.width, ((y - b.top) * c.height) / b.height];
              return [...c.getContext('2d').getImageData(...place, 1, 1).data];
            }""",
            [x, y],
        )
        low, top = (float(t) for t in page.locator('#slices .scales b').all_text_contents()[:2])
        value = data.volume[i, j, z]
        assert abs(grey[0] - np.clip((value - low) / (top - low) * 256, 0, 255)) <= 2, (i, j, grey)


def test_a_click_moves_the_crosshair_and_the_other_planes_follow(page):
    box = page.locator('[data-axis="1"]').bounding_box()
    y = at(page)[1]
    page.mouse.click(box['x'] + box['width'] * 4.5 / SHAPE[0], box['y'] + box['height'] * (1 - 2.5 / SHAPE[2]))
    settled(page)
    assert at(page) == (4, y, 2)
    captions = page.locator('#slices figcaption').all_text_contents()
    assert captions[0].startswith('Axial, z = -16.0') and captions[2].startswith('Sagittal, x = 2.5')


def test_layers_curtain_and_side_by_side(page):
    def picture():
        return page.evaluate('document.querySelector(\'[data-axis="2"]\').toDataURL()')

    seen = {picture()}
    for i, name in enumerate(('Truth', 'Difference', 'Error'), 2):
        press(page, str(i))
        assert page.locator('#slices button[aria-pressed=true]').first.text_content() == f'{i} {name}'
        seen.add(picture())
    assert len(seen) == 4
    press(page, 's')
    assert page.locator('#slices canvas.picture').count() == 12
    press(page, '1', 'c', ']')
    assert page.locator('#slices canvas.picture').count() == 3
    assert '55 %' in page.locator('#slices output').all_text_contents()
    assert picture() not in seen
    press(page, 'o')
    assert picture() in seen


def test_the_map_of_errors_is_a_layer_of_its_own_scale(chromium, tmp_path):
    wrong = np.random.default_rng(3).random(SHAPE) * 1e-3
    with opened(chromium, write_report(tmp_path, content(error_map=wrong)).as_uri()) as page:
        press(page, '5')
        assert page.locator('#slices button[aria-pressed=true]').first.text_content() == '5 Error map'
        shown, index = readout(page), at(page)
        assert abs(float(shown['Error map']) - wrong[index]) < 1e-3 / 255
        assert float(page.locator('#slices .scales b').all_text_contents()[-1]) == pytest.approx(wrong.max(), rel=0.01)
        colours = page.evaluate(
            """() => { const c = document.querySelector('[data-axis="2"]');
              const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
              return new Set(Array.from({ length: d.length / 4 }, (_, i) => d.slice(4 * i, 4 * i + 3).join())).size; }"""
        )
        assert colours > 100  # its own scale: on the density's scale it would be almost black
        press(page, '1', 'c', 's')
        assert page.locator('#slices canvas.picture').count() == 15


def test_window_level_and_zoom(page):
    def picture():
        settled(page)
        return page.evaluate('document.querySelector(\'[data-axis="2"]\').toDataURL()')

    first = picture()
    box = page.locator('[data-axis="2"]').bounding_box()
    page.mouse.move(box['x'] + 50, box['y'] + 50)
    page.mouse.down(button='right')
    page.mouse.move(box['x'] + 130, box['y'] + 50)
    page.mouse.up(button='right')
    wider = picture()
    press(page, '+')
    zoomed = picture()
    press(page, '0')
    page.mouse.move(0, 0)
    assert len({first, wider, zoomed}) == 3 and picture() == first


def test_views_are_sorted_and_their_values_those_given(page, data):
    slider = page.locator('#views input').first
    slider.focus()
    press(page, 'ArrowRight', 'ArrowRight')
    assert '3 of 7, at 20.0°' in page.locator('#views output').first.text_content()
    box = page.locator('#views canvas').first.bounding_box()
    page.mouse.move(box['x'] + box['width'] * 4.5 / 18, box['y'] + box['height'] * 2.5 / 12)
    settled(page)
    text = page.locator('#views p[aria-live]').text_content()
    assert 'u = -18.0 mm, v = -14.0 mm' in text
    values = [float(part.split()[-1]) for part in text.partition('mm:')[2].split(',')]
    rendered, measured = data.views[3, 2, 4], data.views_truth[3, 2, 4]  # the view at 20 degrees
    np.testing.assert_allclose(values, [rendered, measured, rendered - measured], atol=2e-4)


def test_the_residual_of_each_view_is_beside_its_angle(page):
    chart = page.locator('#views .chart').nth(1)
    chart.focus()
    press(page, 'ArrowRight', 'ArrowRight', 'ArrowRight')
    assert [float(value) for value in chart.locator('.u-value').all_text_contents()] == [20, 4]


def test_curves_say_their_values(page):
    chart = page.locator('#curves .chart').nth(1)
    chart.focus()
    press(page, 'ArrowRight', 'ArrowRight', 'ArrowRight')
    assert chart.locator('.u-value').all_text_contents() == ['5', '25', '15']
    press(page, *['ArrowRight'] * 3)
    assert chart.locator('.u-value').first.text_content() == '9'


def test_the_cloud_is_drawn_and_turned_by_keys(page):
    def picture():
        page.wait_for_timeout(300)
        return page.locator('#space .stage').screenshot()

    first = picture()
    page.focus('#space .stage')
    press(page, 'ArrowLeft', 'ArrowLeft')
    turned = picture()
    page.get_by_role('button', name='Scanner').click()
    page.get_by_role('button', name='Ellipsoids').click()
    page.get_by_role('button', name='Outer surface').click()
    assert len({first, turned, picture()}) == 3
    assert page.get_by_role('button', name='Scanner').get_attribute('aria-pressed') == 'true'


def test_tab_reaches_everything(page):
    """It reaches each button, slider, list, slice, view, chart and the scene once, and each shows that it has the focus."""
    wanted = page.evaluate(
        """() => { const all = [...document.querySelectorAll('a[href], button, input, select, summary, [tabindex="0"]')]
        .filter((e) => e.checkVisibility()); all.forEach((e, i) => { e.dataset.n = i; }); return all.length; }"""
    )
    reached = []
    for _ in range(wanted):
        page.keyboard.press('Tab')
        here = page.evaluate(
            '(() => { const e = document.activeElement; return [e.dataset.n, getComputedStyle(e).outlineStyle]; })()'
        )
        assert here[1] != 'none', here
        reached.append(int(here[0]))
    assert sorted(reached) == list(range(wanted)) and wanted > 25
    names = page.evaluate(
        """() => [...document.querySelectorAll('canvas.picture, .chart, .stage, input, select')]
        .filter((e) => e.checkVisibility())
        .filter((e) => !(e.getAttribute('aria-label') || e.closest('label')?.textContent)).length"""
    )
    assert names == 0  # none without a name


def test_in_the_frame_of_a_notebook(chromium, data, tmp_path):
    (tmp_path / 'notebook.html').write_text(f'<!doctype html><body>{Page(report_page(data))._repr_html_()}')
    with opened(chromium, (tmp_path / 'notebook.html').as_uri(), ready=False) as page:
        frame = page.frame_locator('iframe')
        frame.locator('html[data-ready]').wait_for()
        assert frame.locator('#slices canvas.picture').count() == 3


@pytest.mark.parametrize('dark', [False, True], ids=['light', 'dark'])
def test_contrast(chromium, address, dark):
    with opened(chromium, address, dark=dark) as page:
        assert page.evaluate('document.documentElement.dataset.theme') == ('dark' if dark else 'light')
        press(page, 'c', '?')
        contrasts = page.evaluate(CONTRAST)
        assert contrasts['low'] == [] and contrasts['looked'] > 80
        page.click('#theme')
        settled(page)
        assert page.evaluate(CONTRAST)['low'] == []


@pytest.mark.parametrize(
    'changes',
    [
        dict(truth=None, views_truth=None),
        dict(views=None, views_truth=None, cloud_centres=None, metrics={}),
        dict(truth=None, views=None, views_truth=None, cloud_centres=None, metrics={}, error_map=np.zeros(SHAPE)),
        dict(volume=None, truth=None, shape=SHAPE),
        dict(volume=np.zeros((9, 9, 9)), truth=np.zeros((9, 9, 9))),
        dict(volume=np.ones((24, 20, 1)), truth=None, views=np.ones((3, 1, 18)), views_truth=np.ones((3, 1, 18)),
             views_angles=np.arange(3.0)),
    ],
    ids=['measured', 'volume-only', 'blank-map', 'no-volume', 'blank', 'fan-beam'],
)  # fmt: skip
def test_what_is_missing_is_left_out(chromium, tmp_path, changes):
    data = content(**changes)
    with opened(chromium, write_report(tmp_path, data).as_uri()) as page:
        settled(page)
        assert page.locator('#slices').is_visible() == (data.volume is not None)
        assert page.locator('#views').is_visible() == (data.views is not None)
        assert page.locator('#curves').is_visible() == bool(data.history)
        press(page, '2', 's', 'c', '9')


def test_a_profile_follows_the_crosshair(page, data):
    """It shows the values of the volume and of the truth along x, in mm."""
    page.evaluate('document.querySelector("canvas[data-axis=\\"2\\"]").focus()')
    press(page, 'ArrowUp', 'PageUp')
    _, y, z = at(page)
    chart = page.locator('#slices .chart').first
    x, *lines = chart.evaluate('(chart) => chart.plot.data.map((row) => [...row])')
    places = CENTRE[0] + (np.arange(SHAPE[0]) + 0.5 - SHAPE[0] / 2) * SPACING[0]
    np.testing.assert_allclose(x, places)
    for line, volume in zip(lines, (data.volume, data.truth)):
        np.testing.assert_allclose(line, volume[:, y, z], atol=1e-4)


def test_a_region_has_the_statistics_of_its_voxels(page, data):
    page.get_by_role('button', name='Region').click()
    page.evaluate('document.querySelector("canvas[data-axis=\\"2\\"]").focus()')
    first = at(page)
    press(page, 'a', 'ArrowRight', 'ArrowRight', 'ArrowUp', 'b')
    last = at(page)
    voxels = data.volume[first[0] : last[0] + 1, first[1] : last[1] + 1, first[2]]
    assert voxels.shape == (3, 2)
    row = page.locator('tr[data-layer=Reconstruction] td')
    values = [float(cell.text_content()) for cell in row.all()]
    np.testing.assert_allclose(values, [voxels.mean(), voxels.std(), voxels.min(), voxels.max()], atol=2e-5)
    assert '3.0 × 3.0 mm, 3 × 2 voxels' in page.locator('#slices .note', has_text='Region').text_content()


def test_a_line_is_drawn_and_the_histogram_counts_all_voxels(page, data):
    page.get_by_role('button', name='Line', exact=True).click()
    box = page.locator('canvas[data-axis="2"]').bounding_box()
    page.mouse.move(box['x'] + 0.25 * box['width'], box['y'] + 0.5 * box['height'])
    page.mouse.down()
    page.mouse.move(box['x'] + 0.75 * box['width'], box['y'] + 0.5 * box['height'])
    page.mouse.up()
    settled(page)
    charts = page.locator('#slices .chart')
    x = charts.first.evaluate('(chart) => [...chart.plot.data[0]]')
    assert x[-1] == pytest.approx(SHAPE[0] * SPACING[0] / 2, abs=SPACING[0])
    counts = charts.nth(1).evaluate(
        '(chart) => chart.plot.data.slice(1).map((row) => row.reduce((a, b) => a + (b || 0), 0))'
    )
    assert counts == [data.volume.size] * 2


def test_psnr_of_each_view_is_in_the_order_of_the_angles(page, data):
    plotted = page.locator('#views .chart').first.evaluate('(chart) => [...chart.plot.data[1]]')
    order = np.argsort(data.views_angles)
    errors = np.square(data.views - data.views_truth).mean((1, 2))[order]
    np.testing.assert_allclose(plotted, 10 * np.log10(data.views_truth.max() ** 2 / errors))


def test_the_differences_of_views_have_a_scale_of_their_own(page):
    slider = page.locator('#views label', has_text='Differences').locator('input')
    slider.focus()
    before = page.locator('#views .scales').text_content()
    press(page, 'ArrowRight', 'ArrowRight')
    assert page.locator('#views .scales').text_content() != before
