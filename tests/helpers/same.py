"""Comparisons of results that must not depend on the way they are computed."""

import os

import drjit as dr
import mitsuba as mi
import numpy as np

STAND_IN = 'LINGO_MI_CUDA_STAND_IN' in os.environ  # for the CUDA driver: one thread, without OptiX


def adds_in_any_order() -> bool:
    """Return whether the active variant adds atomically, so that sums differ by rounding. A real GPU does."""
    return dr.backend_v(mi.Float) == dr.JitBackend.CUDA and not STAND_IN


def assert_same(actual, expected):
    """Require equality to the last bit, or up to rounding if sums are in any order."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    if adds_in_any_order():
        np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=2e-6 * np.abs(expected).max())
    else:
        np.testing.assert_array_equal(actual, expected)


def assert_same_volume(actual, expected):
    """Compare volumes of an iterative method, which amplifies rounding: to the last bit, or to a thousandth of the norm."""
    if adds_in_any_order():
        assert np.linalg.norm(actual - expected) < 1e-3 * np.linalg.norm(expected)
    else:
        np.testing.assert_array_equal(actual, expected)


def fits_alike(otherwise: float) -> float:
    """Relative tolerance of the measures of two like fits, which amplify rounding if sums are in any order."""
    return 1e-2 if adds_in_any_order() else otherwise
