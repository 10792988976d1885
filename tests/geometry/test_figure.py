"""`Geometry.show`: where the figure's parts are, in mm, for every kind of scan; what is refused."""

import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import Geometry, circular
from lingo_mi.geometry.drawing import PANEL, SOURCE, VOLUME

SCAN = dict(nDetector=(30, 40), dDetector=2.0, nVoxel=(20, 30, 10), dVoxel=2.0, offOrigin=(5.0, -3.0, 4.0))
CONE = dict(DSO=300.0, DSD=450.0, **SCAN)
ANGLES = circular(8, start=30)
SCANS = {
    'cone': Geometry.cone(**CONE, angles=ANGLES),
    'half fan': Geometry.cone(**CONE, angles=ANGLES, offDetector=(0.0, 30.0)),
    'parallel': Geometry.parallel(**SCAN, angles=ANGLES),
    'tilted': Geometry.cone(**CONE, angles=ANGLES, tilt=0.3, rotDetector=(0.1, 0.2, 0.3)),
    'laminography': Geometry.cone(**CONE, angles=ANGLES, tilt=1.0),
    'flat panel': Geometry.cone(**CONE, angles=ANGLES, tilt=np.pi / 2),
    'helix': Geometry.helix(**CONE, angles=circular(16, 720, -360), pitch=40),
}
each_scan = pytest.mark.parametrize('scan', SCANS.values(), ids=SCANS)


def lines(axes, colour, width):
    return [x.get_xydata() for x in axes.lines if x.get_color() == colour and x.get_linewidth() == width]


def panel_of(scan, view):
    rays = scan.rays()
    u, v = 40 * rays.u[view], 30 * rays.v[view]
    return rays.corner[view] + np.array([0 * u, u, u + v, v, 0 * u])


@each_scan
def test_parts_are_where_they_are(scan):
    figure = scan.show(views=[2, 0])
    above, side = figure.axes
    assert isinstance(figure, Figure) and (above.get_xlabel(), above.get_ylabel()) == ('x, mm', 'y, mm')
    assert above.get_aspect() == side.get_aspect() == 1
    first, other = panel_of(scan, 2), panel_of(scan, 0)
    for actual, expected in zip(lines(above, PANEL, 2.5), (other, first)):  # the strongest last
        np.testing.assert_allclose(actual, expected[:, :2])
    (panel,) = lines(side, PANEL, 2.5)
    np.testing.assert_allclose(panel[:, 1], first[:, 2])
    if scan is not SCANS['flat panel']:  # seen along the panel, which stands beyond the volume or at its axis
        normal = np.cross(scan.rays().u[2], scan.rays().v[2])
        across = abs(normal[:2] @ normal[:2]) ** 0.5 / np.linalg.norm(normal)
        spread = panel - panel.mean(0)
        assert np.linalg.matrix_rank(spread, tol=1e-6) == 1 and across > 0.02
        assert panel[:, 0].mean() > -1e-6
    for axes, planes in ((above, [0, 1]), (side, [2])):
        [box] = [p.get_xy() for p in axes.patches if p.get_edgecolor()[:3] == _rgb(VOLUME)]
        extent = box.max(0) - box.min(0)
        np.testing.assert_allclose(extent[-len(planes) :], np.array(scan.grid.size)[planes])
    dots = next(x.get_xydata() for x in above.lines if x.get_color() == SOURCE and len(x.get_xdata()) == len(scan))
    if scan.mode == 'cone':
        np.testing.assert_allclose(dots, scan.rays().source[:, :2])
    else:  # before the volume, against the beam
        away = dots - np.array(scan.grid.centre)[:2]
        np.testing.assert_allclose(away / np.linalg.norm(away, axis=1)[:, None], -scan.rays().source[:, :2], atol=1e-12)


def _rgb(colour):
    from matplotlib.colors import to_rgb

    return to_rgb(colour)


def test_rays_of_a_parallel_beam_run_along_it():
    scan = SCANS['parallel']
    above, _ = scan.show(views=[1]).axes
    rays = lines(above, '#7a8694', 0.8)
    assert len(rays) == 5
    for start, end in rays:
        beam = (end - start) / np.linalg.norm(end - start)
        np.testing.assert_allclose(beam, scan.rays().source[1, :2], atol=1e-9)


def test_views_are_chosen():
    scan = SCANS['cone']
    numbers = [[t.get_text() for t in scan.show(views=v).axes[0].texts] for v in (None, slice(1, 3), [7])]
    assert numbers == [['0', '2', '5'], ['1', '2'], ['7']]
    one = Geometry.cone(**CONE, angles=[0.0]).show()
    assert [t.get_text() for t in one.axes[0].texts] == ['0'] and '1 view,' in one.get_suptitle()
    assert scan.show()._repr_png_()[1:4] == b'PNG'


@pytest.mark.parametrize(
    'views, message', [([8], 'from 0 to 7'), ('ab', 'from 0 to 7'), ([], 'at least one'), ([0.5], '0 to 7')]
)
def test_bad_views(views, message):
    with pytest.raises(InputError, match=message) as caught:
        SCANS['cone'].show(views)
    assert '\n' not in str(caught.value)


def test_matplotlib_is_loaded_late_and_without_windows():
    program = (
        'import sys; from lingo_mi.geometry import Geometry; print("matplotlib" in sys.modules); '
        'Geometry.parallel(nDetector=8, dDetector=1, nVoxel=8, dVoxel=1, angles=[0.0]).show(); '
        'print("matplotlib.pyplot" in sys.modules)'
    )
    process = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True)
    assert process.stdout.split() == ['False', 'False']
