"""Numbers of a response are found from expected and measured views, and undone."""

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.calibration.response.part import Place
from lingo_mi.calibration.response.response import Response
from lingo_mi.geometry import circular

VIEWS, SHAPE = 12, (24, 20)
GEOMETRY = lm.Geometry.cone(
    DSO=500, DSD=700, nDetector=SHAPE, dDetector=1.0, nVoxel=8, dVoxel=1.0, angles=circular(VIEWS)
)
ALL = dict(air='view', gain='smooth', curve=2, scatter='one')


def expected():
    """Line integrals up to 3, with air around, that differ from view to view."""
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing='ij')
    views = []
    for a in GEOMETRY.angles:
        ball = np.sqrt(np.maximum(0, 0.5 - (x - 0.2 * np.cos(a)) ** 2 - (y - 0.1) ** 2))
        views.append(3.2 * ball * (1 + 0.4 * np.sin(5 * x + a) * np.sin(6 * y)))
    return np.array(views)


def drawn(seed=0, **parts):
    """A response of moderate random numbers."""
    p = expected()
    response = Response.of(GEOMETRY, highest=float(p.max()), **parts)
    rng = np.random.default_rng(seed)
    for part in response.parts:
        part.values = 0.3 * part.deviations * rng.normal(size=part.values.shape)
        if part.name == 'scatter':
            part.values *= 0.1
            part.values[0, 0] = 0.02  # light, everywhere
        if part.name == 'curve':
            part.values[:] = [[-0.03, 0.002]][: len(part.values)]
        part.hold()
    return response, p


@pytest.mark.parametrize('parts', [dict(air='view'), dict(gain='smooth'), dict(curve=2), dict(scatter='one'), ALL])
def test_undone_is_the_inverse(parts):
    response, p = drawn(**parts)
    measured = response.applied(p, GEOMETRY)
    assert np.abs(measured - p).max() > 0.02
    np.testing.assert_allclose(response.undone(measured, GEOMETRY), p, atol=2e-5)


def test_derivatives_by_differences():
    response, p = drawn(**ALL)
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing='ij')
    place, h = Place(y, x), 1e-5
    for part in response.parts:
        c = part.values[0] + (0.01 if part.name == 'scatter' else 0)
        by_numbers, by_p = part.slopes(p[0], c, place)
        for k, actual in enumerate(by_numbers):
            e = h * np.eye(len(c))[k]
            np.testing.assert_allclose(
                actual, (part.apply(p[0], c + e, place) - part.apply(p[0], c - e, place)) / (2 * h), atol=1e-5
            )
        inside = np.abs(p[0] - h) > 2 * h  # the curve has a corner in its slope at 0
        actual = (part.apply(p[0] + h, c, place) - part.apply(p[0] - h, c, place)) / (2 * h)
        np.testing.assert_allclose(by_p[inside], actual[inside], atol=1e-4)


def test_negative_light_is_doubted_beyond_three_standard_errors():
    response = Response.of(GEOMETRY, air='view', curve=1, scatter='one')
    errors = dict.fromkeys(response.names(), np.inf) | {f'scatter0_{k}': 1e-3 for k in range(6)}
    light = {'scatter0_0': 0.02, 'scatter0_1': 0.015, 'scatter0_5': 0.004}
    assert response.doubts(light, errors) == {}
    assert response.doubts(light | {'scatter0_1': 0.021}, errors) == {}  # -0.003 +- 0.002 at an edge
    assert list(response.doubts(light | {'scatter0_1': 0.03}, errors)) == [f'scatter0_{k}' for k in range(6)]
    assert response.doubts({'air0': -1.0, 'curve0': -5.0}, errors) == {}


@pytest.mark.parametrize(
    ('parts', 'within'),
    [
        (dict(air='view'), dict(air=5e-4)),
        (dict(air='smooth', gain='view'), dict(air=5e-4, gain=2e-3)),
        (dict(air='view', curve=2), dict(air=5e-4, curve=2e-3)),
        (dict(air='view', scatter='one'), dict(air=2e-3, scatter=1e-3)),
    ],
)
def test_numbers_are_found(parts, within):
    """From views with noise of 0.003, air is found to 0.0005, gain to 0.2 %, scatter to a thousandth of the open beam."""
    true, p = drawn(**parts)
    measured = true.applied(p, GEOMETRY) + np.random.default_rng(1).normal(0, 0.003, p.shape).astype(np.float32)
    response = Response.of(GEOMETRY, highest=float(p.max()), **parts)
    response.fit(p, measured)
    for a, b in zip(response.parts, true.parts):
        assert np.abs(a.values - b.values).max() < within[a.name], a.name
    assert np.std(measured - response.applied(p, GEOMETRY)) < 0.0031
    assert np.std(measured - p) > 0.006


def test_invalid_pixels_and_outliers_are_left_alone():
    true, p = drawn(air='view')
    measured = true.applied(p, GEOMETRY) + np.random.default_rng(1).normal(0, 0.003, p.shape).astype(np.float32)
    valid = np.ones(p.shape, bool)
    valid[:, :6], measured[:, :6] = False, 100
    measured[:, 10, 4] += 5  # a pixel that nobody has noticed
    response = Response.of(GEOMETRY, air='view')
    response.fit(p, measured, valid)
    assert np.abs(response.parts[0].values - true.parts[0].values).max() < 1e-3


def test_views_between_get_numbers_between():
    response, p = drawn(air='view', gain='smooth')
    between = lm.Geometry.cone(
        **{k: v for k, v in GEOMETRY.numbers().items() if k not in ('mode', 'angles')}, angles=circular(VIEWS, start=15)
    )
    air = response.parts[1].values[:, 0]
    at_zero = response.applied(np.zeros_like(p), between)
    np.testing.assert_allclose(at_zero[:-1, 0, 0], (air[:-1] + air[1:]) / 2, atol=1e-6)
    np.testing.assert_allclose(at_zero[-1, 0, 0], air[-1], atol=1e-6)


def test_curves_rise():
    response = Response.of(GEOMETRY, curve=2, highest=3.0)
    response.parts[0].values[:] = [[-0.5, 0.0]]
    response.parts[0].hold()
    p = np.linspace(0, 3, 50)
    assert np.all(np.diff(response.parts[0].apply(p, response.parts[0].values[0], None)) > 0)


def test_checkpoint_and_report():
    response, _ = drawn(**ALL)
    again = Response.of(GEOMETRY, highest=float(expected().max()), **ALL)
    again.restore(response.arrays())
    actual = again.report()
    assert actual == response.report() and len(actual['air_level']) == VIEWS == len(actual['gain_percent'])
    assert len(actual['hardening_percent_at_highest']) == 1 and actual['scatter_percent_of_open_beam'][0] > 0
    assert Response.of(GEOMETRY) is None
