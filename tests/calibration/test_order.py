"""Sound scans are left in peace; a wrong order, sense or unit of the angles is told, and so are single views out of place."""

from dataclasses import replace

import numpy as np
import pytest

import lingo_mi as lm
from helpers.object_scan import scanned
from lingo_mi.calibration.order import order_faults


@pytest.fixture(scope='module')
def foot():
    return scanned('foot', views=24)


@pytest.mark.parametrize(
    'name', ['foot', *(pytest.param(n, marks=pytest.mark.thorough) for n in ('chest', 'gaussians', 'shepp_logan'))]
)
@pytest.mark.parametrize(
    ('total', 'views', 'mode'),
    [(360, 24, 'cone'), (180, 20, 'cone'), (60, 20, 'cone'), (180, 50, 'parallel'), (360, 6, 'cone')],
)
def test_sound_scans(name, total, views, mode):
    assert order_faults(scanned(name, mode, views, total)) == []


def placed(scan, order):
    return replace(scan, projections=scan.projections[order])


@pytest.mark.parametrize(
    ('order', 'words'),
    [
        (np.random.default_rng(1).permutation(24), 'hardly better than in a random order'),
        (sorted(range(24), key=str), 'hardly better than in a random order'),  # 0, 1, 10, 11, ...
        (np.arange(24)[::-1], 'with reversed angles'),
    ],
)
def test_a_wrong_order(foot, order, words):
    (fault,) = order_faults(placed(foot, np.asarray(order)))
    assert words in fault


def test_two_views_in_each_others_place():
    order = np.arange(60)
    order[[10, 31]] = order[[31, 10]]
    (fault,) = order_faults(placed(scanned('foot', views=60), order))
    assert fault.startswith('views 10, 31: ')


def test_radians_for_degrees(foot):
    wrong = replace(foot.geometry, angles=np.radians(foot.geometry.angles))
    (fault,) = order_faults(replace(foot, geometry=wrong))
    assert 'check the angles' in fault


@pytest.mark.parametrize('level', [0.02, -0.02])
@pytest.mark.parametrize('sense', [1, -1])
def test_a_drift_of_the_beam_hides_no_sense(level, sense):
    """The sense is told although the beam drifts by 2 % of the exposure over 60 views, with line integrals up to 1."""
    scan = scanned('foot', views=60)
    p = scan.projections / scan.projections.max() + np.linspace(-level, level, 60)[:, None, None]
    faults = order_faults(lm.Scan(replace(scan.geometry, angles=sense * scan.geometry.angles), p))
    assert len(faults) == (sense < 0) and all('with reversed angles' in fault for fault in faults)


def test_a_parallel_beam_tells_no_sense():
    scan = scanned('foot', 'parallel', 40, 180)
    assert order_faults(replace(scan, geometry=replace(scan.geometry, angles=-scan.geometry.angles))) == []


@pytest.mark.parametrize(('mode', 'total'), [('parallel', 180), ('cone', 200)])
def test_an_axis_off_centre_damages_no_view(mode, total):
    scan = scanned('foot', mode, 50, total)
    assert order_faults(lm.Scan(scan.geometry, np.roll(scan.projections, 1, 2))) == []


def test_a_first_view_out_of_place():
    scan = scanned('foot', views=60)
    (fault,) = order_faults(placed(scan, np.array([20, *range(1, 60)])))
    assert fault.startswith('view 0: ')


@pytest.mark.thorough
def test_a_calibration_warns(foot):
    with pytest.warns(UserWarning, match='with reversed angles'):
        lm.calibrate(placed(foot, np.arange(24)[::-1]), progress=False)
