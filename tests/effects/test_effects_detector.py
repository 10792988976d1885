"""The detector's noise by chi-square, its blur by edges, and its way back to line integrals."""

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import Detector, taps
from lingo_mi.effects.focal_spot import FocalSpot, square
from lingo_mi.effects.forward import Effects
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.projectors.view import View

SHAPE = 120, 150


def detector(**changes):
    return Detector.of(**{**Detector.DEFAULTS, **changes})


def flat(value):
    return np.full(SHAPE, float(value))


# ---- noise -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('photons, transmission, electronic', [(1e5, 0.3, 0.0), (20, 0.25, 0.0), (100, 0.1, 5.0)])
def test_mean_and_variance(photons, transmission, electronic):
    """For 18000 pixels, the mean is within four standard errors, and the sum of squares passes a chi-square test."""
    d = detector(photons=float(photons), electronic_noise=electronic)
    counts = d.signal(flat(transmission), 0) * photons
    mean, variance = photons * transmission, photons * transmission + electronic**2
    n = counts.size
    assert abs(counts.mean() - mean) < 4 * np.sqrt(variance / n)
    # The variance of a sample variance is (kurtosis - 1) / n; a Poisson's excess is 1 / mean.
    excess = photons * transmission / variance**2
    deviation = np.sqrt((2 + excess) / n)
    assert abs(((counts - mean) ** 2).mean() / variance - 1) < 4 * deviation


def test_counts_are_poisson():
    """The histogram of counts agrees with the distribution, by chi-square."""
    counts = np.rint(detector(photons=20.0).signal(flat(0.25), 0) * 20).astype(int)
    expected = stats.poisson.pmf(np.arange(14), 5) * counts.size
    histogram = np.bincount(counts.ravel(), minlength=14)[:14]
    assert stats.chi2.sf(((histogram - expected) ** 2 / expected).sum(), 13) > 1e-3


def test_pixels_views_and_seeds_are_independent():
    d = detector(photons=1e4)
    one = d.signal(flat(0.5), 0) - 0.5
    others = [
        d.signal(flat(0.5), 1) - 0.5,
        d.signal(flat(0.5), 0, seed=1) - 0.5,
        np.roll(one, 1, 0),
        np.roll(one, 1, 1),
    ]
    for other in others:
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 4 / np.sqrt(one.size)


def test_same_key_same_noise_in_any_order():
    d = detector(photons=1e4, electronic_noise=3.0)
    forwards = [d.measure(flat(0.5), i, 7) for i in range(3)]
    backwards = [d.measure(flat(0.5), i, 7) for i in (2, 1, 0)][::-1]
    np.testing.assert_array_equal(forwards, backwards)


# ---- signal ----------------------------------------------------------------------------------------------------------


def test_darkness_is_finite():
    """Without light, and with read-out noise that makes counts negative, a floor of half a count or half a step holds."""
    for d, floor in (
        (detector(photons=100.0, electronic_noise=4.0), 0.005),
        (detector(bits=8), 0.5 * 1.25 / 255),
        (detector(saturation=2.0), 1e-30),
    ):
        p = d.measure(flat(0), 0)
        assert np.isfinite(p).all() and p.max() <= -np.log(np.float32(floor)) * (1 + 1e-6)
        np.testing.assert_allclose(d.floor, floor)


def test_saturation_and_bits():
    ramp = np.linspace(0, 1.2, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    np.testing.assert_array_equal(detector(saturation=0.8).signal(ramp, 0), np.minimum(ramp, 0.8))
    signal = detector(saturation=0.8, bits=4).signal(ramp, 0)
    assert len(np.unique(signal)) == 16
    assert np.abs(signal - np.minimum(ramp, 0.8)).max() <= 0.5 * 0.8 / 15 * (1 + 1e-12)


def test_gains_and_dead_pixels_are_corrected():
    smooth = np.exp(-1 - 0.3 * np.sin(np.indices(SHAPE)[1] / 30))
    raw, corrected = (detector(gain=0.1, dead=0.02, corrected=c) for c in (False, True))
    dead = raw.maps(SHAPE)[1]
    assert abs(dead.mean() - 0.02) < 4 * np.sqrt(0.02 * 0.98 / dead.size)
    assert abs(raw.maps(SHAPE)[0].std() - 0.1) < 0.003
    np.testing.assert_allclose(corrected.measure(smooth, 0)[~dead], -np.log(smooth)[~dead], atol=1e-6)
    assert np.abs(corrected.measure(smooth, 0) + np.log(smooth))[dead].max() < 0.02
    assert np.abs(raw.measure(smooth, 0) + np.log(smooth))[~dead].std() > 0.05
    np.testing.assert_allclose(raw.measure(smooth, 0)[dead], -np.log(raw.floor), rtol=1e-6)


def test_all_dead():
    assert np.isfinite(detector(dead=1.0).measure(flat(0.5), 0)).all()


@pytest.mark.parametrize(
    'change, match',
    [
        (dict(photons=-1.0), 'photons must be a number from 0'),
        (dict(photons=np.nan), 'photons'),
        (dict(photons='many'), 'photons'),
        (dict(photons=1.0, electronic_noise=-1.0), 'electronic_noise'),
        (dict(electronic_noise=1.0), 'needs photons'),
        (dict(bits=25), 'bits must be a whole number'),
        (dict(bits=2.5), 'bits'),
        (dict(dead=1.1), 'dead'),
        (dict(aperture=2.0), 'aperture'),
        (dict(aperture_order=0), 'aperture_order'),
        (dict(response='colour'), 'response'),
        (dict(seed=-1), 'seed'),
        (dict(corrected=1), 'corrected'),
    ],
)
def test_impossible_detectors(change, match):
    with pytest.raises(InputError, match=match):
        detector(**change)


# ---- blur ------------------------------------------------------------------------------------------------------------


def test_a_point_spread_of_no_width_changes_nothing(variant):
    frames = CircularGeometry(DSO=100, DSD=150, nDetector=5, dDetector=1, angles=[0.0], grid=Grid(4, 1)).rays()
    image = np.random.default_rng(0).random(25).astype(np.float32)
    blurred = detector(psf=1e-6).blurred(mi.Float(image), View.of(frames, 0, 5, 5))
    np.testing.assert_allclose(blurred.numpy(), image, rtol=1e-6)


@pytest.mark.parametrize(
    'sigma, softness, most',
    [(0.7, 1.0, 5e-4), (1.0, 1.0, 2e-5), (2.3, 1.0, 2e-5), (1.0, 0.0, 0.0107), (2.3, 0.0, 0.00201)],
)
def test_edge_response_of_the_point_spread(sigma, softness, most):
    """An edge of light becomes the error function. A step between two pixels is off by the midpoint rule's error, 1/24 of
    the greatest slope of a Gaussian, .0101 / sigma^2 (here plus 5 %)."""
    weights = taps(sigma)
    at = np.arange(80) + 0.5 - 40
    edge = np.convolve(stats.norm.cdf(at / softness) if softness else (at > 0).astype(float), weights, mode='same')
    error = np.abs(edge - stats.norm.cdf(at / np.hypot(sigma, softness)))[20:60].max()
    assert error < most


def test_quadrature_of_a_soft_edge():
    """The response of a uniform spot to an edge that is an error function converges to the integral by hand, exponentially in
    n."""

    def antiderivative(x):
        return x * stats.norm.cdf(x) + stats.norm.pdf(x)

    at, width = np.linspace(-3, 3, 61), 2.0
    exact = (antiderivative(at + width / 2) - antiderivative(at - width / 2)) / width
    errors = []
    for order in (2, 4, 8):
        actual = sum(w * stats.norm.cdf(at + width * x) for w, x, y in square(order))
        errors.append(np.abs(actual - exact).max())
    assert errors[0] < 2e-2 and errors[1] < 1e-4 and errors[2] < 1e-9


@pytest.mark.parametrize(
    'size, order, match',
    [
        ('-1', 3, 'focal_spot'),
        ('1, 2, 3', 3, 'focal_spot'),
        ('wide', 3, 'focal_spot'),
        ('nan', 3, 'focal_spot'),
        ('1', 0, 'focal_order'),
        ('1', 17, 'focal_order'),
        ('1', 2.5, 'focal_order'),
    ],
)
def test_impossible_spots(size, order, match):
    with pytest.raises(InputError, match=match):
        FocalSpot.of(size, order)


def test_spot_larger_than_the_distance_of_the_source():
    with pytest.raises(InputError, match='is not smaller than the distance of the source, 5 mm'):
        FocalSpot.of('6', 3).check(5.0)
    with pytest.raises(InputError, match='a parallel beam has no focal spot'):
        FocalSpot.of('6', 3).check(None)
    FocalSpot().check(None)


def test_a_binned_panel_has_the_noise_of_its_pixels_and_none_of_its_dead_ones():
    geometry = lm.Geometry.parallel(nDetector=(64, 64), dDetector=1, nVoxel=4, dVoxel=1, angles=[0.0, 1.0])
    panel = Detector(photons=1000.0, dead=0.02)
    seen = np.array([panel.measure(np.full((64, 64), 0.5), view) for view in range(2)])
    binned = lm.Scan(geometry, seen, effects=Effects(detector=panel)).binned(2)
    dead = panel.maps((64, 64))[1].reshape(32, 2, 32, 2).any((1, 3))
    np.testing.assert_array_equal(binned.valid, np.broadcast_to(~dead, (2, 32, 32)))
    expected = binned.effects.detector.deviation(0.5)
    assert binned.projections[binned.valid].std() == pytest.approx(expected, rel=0.1)
    assert binned.effects.masked(binned).valid.sum() == binned.valid.sum()


def test_the_seed_says_which_pixels_are_dead_and_what_the_gains_are():
    maps = [detector(gain=0.1, dead=0.1, seed=seed).maps((40, 50)) for seed in (0, 1, 2**62)]
    for (gains, dead), (others, alive) in zip(maps, maps[1:]):
        assert abs(np.corrcoef(gains.ravel(), others.ravel())[0, 1]) < 0.1 and np.any(dead != alive)


def test_a_binned_panel_rounds_more_finely():
    light = np.random.default_rng(0).uniform(0.3, 0.9, (200, 4, 200, 4)).mean((1, 3), keepdims=True)
    light = light + np.random.default_rng(1).uniform(-0.02, 0.02, (200, 4, 200, 4))
    coarse = detector(bits=6)
    seen = coarse.signal(light.reshape(800, 800), 0).reshape(light.shape)
    wrong = np.log(seen.mean((1, 3)) / light.mean((1, 3)))
    assert wrong.std() == pytest.approx(coarse.binned(16).deviation(light.mean((1, 3))).mean(), rel=0.1)
