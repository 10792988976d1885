"""What does not depend on how it is asked for."""

import drjit as dr
import numpy as np
from conftest import STAND_IN


def assert_same(found, expected):
    """To the last bit; on a GPU, which adds atomically in any order, up to rounding."""
    found, expected = np.asarray(found), np.asarray(expected)
    if dr.has_backend(dr.JitBackend.CUDA) and not STAND_IN:
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-6 * np.abs(expected).max())
    else:
        np.testing.assert_array_equal(found, expected)
