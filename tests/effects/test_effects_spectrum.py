"""Spectra, attenuation and energy bands, against published numbers and the full spectrum."""

import numpy as np
import pytest
from scipy.optimize import brentq

from lingo_mi.common.errors import InputError
from lingo_mi.effects import spectrum as module
from lingo_mi.effects.bands import Bands, band
from lingo_mi.effects.spectrum import attenuation, monochromatic, tube_spectrum

pytest.importorskip('spekpy', reason="needs pip install 'lingo_mi[physics]'")
pytest.importorskip('xraylib', reason="needs pip install 'lingo_mi[physics]'")


def ratios(spectrum, *materials):
    return [attenuation(m, spectrum.energies) / attenuation(m, [60.0]) for m in materials]


# Mass energy-absorption of dry air, cm2/g, by energy in keV (NIST, Hubbell and Seltzer).
AIR = (
    [10, 15, 20, 30, 40, 50, 60, 80, 100, 150],
    [4.742, 1.334, 0.5389, 0.1537, 0.06833, 0.04098, 0.03041, 0.02407, 0.02325, 0.02496],
)


def half_value_layer(spectrum, material):
    """mm that halve the air kerma, by bisection."""
    air = np.exp(np.interp(np.log(spectrum.energies), np.log(AIR[0]), np.log(AIR[1])))
    kerma, mu = spectrum.photons * spectrum.energies * air, attenuation(material, spectrum.energies)
    low, high = 0.0, 50.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if kerma @ np.exp(-mu * middle) > kerma.sum() / 2 else (low, middle)
    return low


# ---- spectra ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'kvp, angle, filtration, mean, layer',
    [(120, 12, 'Al 2.5', 54.4, 4.22), (120, 12, '', None, None), (80, 12, 'Al 2.5, Cu 0.2', None, None)],
)
def test_tube(kvp, angle, filtration, mean, layer):
    spectrum = tube_spectrum(kvp, angle, filtration)
    assert abs(spectrum.photons.sum() - 1) < 1e-12 and spectrum.energies[-1] < kvp
    if mean:
        # spekpy says 4.22 mm with tables of its own, which agree with xraylib's to 1 %
        assert abs(spectrum.mean - mean) < 0.05 and abs(half_value_layer(spectrum, 'Al') / layer - 1) < 0.01
    else:  # without a filter softer, with copper harder than with aluminium
        assert (spectrum.mean < tube_spectrum(kvp).mean) == (filtration == '')


def test_filter_is_attenuation():
    """A filter of spekpy's and one of xraylib's attenuate alike, to 1.5 % from 30 keV on."""
    thin, thick = tube_spectrum(120, filtration='Al 2.5'), tube_spectrum(120, filtration='Al 7.5')
    high = thin.energies > 30
    expected = thin.photons[high] * np.exp(-5 * attenuation('Al', thin.energies[high]))
    photons = thick.photons[high]
    assert np.abs(photons / photons.sum() / (expected / expected.sum()) - 1).max() < 0.015


def test_second_time_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    made = tube_spectrum(60.0)
    library = module.library
    monkeypatch.setattr(module, 'library', lambda name: pytest.fail('computed again'))
    np.testing.assert_array_equal(tube_spectrum(60.0).photons, made.photons)
    monkeypatch.setattr(module, 'library', library)
    (file,) = (tmp_path / 'lingo_mi' / 'spectra').iterdir()
    for damaged in b'PK damaged', b'':
        file.write_bytes(damaged)
        np.testing.assert_array_equal(tube_spectrum(60.0).photons, made.photons)
    np.savez(file, energies=made.energies, photons=made.photons * np.nan)
    np.testing.assert_array_equal(tube_spectrum(60.0).photons, made.photons)


def test_missing_library(monkeypatch):
    def missing(name):
        raise ImportError

    monkeypatch.setattr(module.importlib, 'import_module', missing)
    with pytest.raises(InputError, match=r'xraylib is not installed: pip install'):
        attenuation('water', [60.0])


@pytest.mark.parametrize(
    'call, match',
    [
        (lambda: tube_spectrum(0.0), 'kvp must be from 20 to 300 kV, not 0'),
        (lambda: tube_spectrum(np.nan), 'kvp'),
        (lambda: tube_spectrum(120, 0.0), 'angle'),
        (lambda: tube_spectrum(120, 12, 'Al'), 'filtration'),
        (lambda: tube_spectrum(120, 12, 'Al -1'), 'filtration'),
        (lambda: tube_spectrum(120, 12, 'Unobtainium 1'), 'filtration'),
        (lambda: tube_spectrum(20, 12, 'Pb 100'), 'no photon of 20 kV passes it'),
        (lambda: monochromatic(0.0), 'energy must be positive'),
        (lambda: attenuation('unobtainium', [60.0]), 'is unknown'),
        (lambda: attenuation('CsI @ -1', [60.0]), 'positive density'),
        (lambda: attenuation('CsI @ much', [60.0]), 'is unknown'),
        (lambda: attenuation('water', [2000.0]), 'xraylib has no attenuation'),
        (lambda: tube_spectrum(120, 12, 2.5), 'filtration'),
    ],
)
def test_refusals(call, match):
    with pytest.raises(InputError, match=match):
        call()


# NIST, tables of X-ray mass attenuation coefficients (Hubbell and Seltzer), times the densities given there.
@pytest.mark.parametrize(
    'material, energy, mu',
    [
        ('water', 40, 0.02683),
        ('water', 60, 0.02059),
        ('water', 100, 0.01707),
        ('pmma', 60, 0.1924 * 0.119),
        ('Al', 60, 0.2778 * 0.2699),
        ('Fe', 60, 1.205 * 0.7874),
        ('Pb', 100, 5.549 * 1.135),
        ('H2O @ 1', 60, 0.02059),
    ],
)
def test_attenuation(material, energy, mu):
    assert abs(attenuation(material, [energy])[0] / mu - 1) < 0.01


# ---- bands -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('response', ['energy', 'count'])
@pytest.mark.parametrize(
    'materials, errors',
    [
        (('water',), (3e-1, 2e-2, 2e-3, 2e-4, 2e-5, 2e-6)),
        (('soft tissue', 'bone'), (9e-1, 2e-1, 2e-2, 3e-3, 6e-4, 2e-4)),
        (('Fe',), (3e0, 4e-1, 1e-1, 3e-2, 8e-3, 5e-3)),
    ],
)
def test_error_against_the_full_spectrum(materials, errors, response):
    """The promised error holds at points that the bands were not fitted to, and falls with the number of bands."""
    spectrum = tube_spectrum(120.0)
    signal, r = spectrum.detected(response), ratios(spectrum, *materials)

    def measured(u):
        return -np.log(np.exp(-u @ np.array(r)) @ signal)

    most = [brentq(lambda p: measured(p * axis) - 10, 0, 100) for axis in np.eye(len(materials))]
    u = np.random.default_rng(0).dirichlet(np.ones(len(materials) + 1), 500)[:, :-1] * most
    exact = measured(u)
    for count, most in enumerate(errors, 1):
        actual = band(signal, r, count, 10.0)
        error = np.abs(actual.hardened(*u.T) - exact).max()
        assert error < 1.1 * actual.error and actual.error < most
        assert abs(actual.weights.sum() - 1) < 1e-12 and actual.weights.min() > 0


@pytest.mark.parametrize('reference', [20.0, 60.0, 110.0])
def test_bands_are_right_at_any_reference_energy(reference):
    """They are right for iron until one photon in two thousand is left."""
    spectrum = tube_spectrum(120.0)
    mu = attenuation('Fe', spectrum.energies)
    actual = band(spectrum.detected('energy'), [mu / attenuation('Fe', [reference])], 5, 10.0)
    thickness = np.linspace(0, 21, 50)  # mm
    exact = -np.log(np.exp(-np.outer(thickness, mu)) @ spectrum.detected('energy'))
    assert exact.max() > 7.5
    np.testing.assert_allclose(actual.hardened(thickness * attenuation('Fe', [reference])), exact, atol=5e-3)


def test_monochromatic_needs_one_band():
    actual = band(np.ones(1), [[1.3], [0.7]], 4, 10.0)
    np.testing.assert_allclose(actual.hardened(2.0, 3.0), 1.3 * 2 + 0.7 * 3)


def test_hard_beam_is_a_straight_line():
    """The more a beam has passed, the less is attenuated of what is left."""
    actual = band(tube_spectrum(120.0).detected('energy'), ratios(tube_spectrum(120.0), 'water'), 4, 10.0)
    p = np.linspace(0, 10, 50)
    slope = np.diff(actual.hardened(p))
    assert actual.hardened(0.0) == pytest.approx(0, abs=1e-12) and np.all(np.diff(slope) < 0)


def test_precorrection_is_the_inverse():
    actual = band(tube_spectrum(120.0).detected('energy'), ratios(tube_spectrum(120.0), 'water'), 4, 10.0)
    p = np.linspace(0, 40, 401).reshape(1, 401)
    np.testing.assert_allclose(actual.precorrected(actual.hardened(p)), p, atol=1e-12)
    slope = actual.weights @ actual.ratios[0]
    np.testing.assert_allclose(actual.precorrected([-0.3, 0.0]), [-0.3 / slope, 0], atol=1e-12)
    with pytest.raises(InputError, match='one material'):
        Bands(np.ones(1), np.ones((2, 1))).precorrected(1.0)


def test_number_of_bands():
    for count in (0, 7):
        with pytest.raises(InputError, match='bands must be from 1 to 6'):
            band(np.ones(3) / 3, [[1.0, 2.0, 3.0]], count, 10.0)
