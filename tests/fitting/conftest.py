"""A scan for the tests of fits."""

import pytest

from helpers.fits import geometry, tiny_scan


@pytest.fixture(scope='module')
def scan():
    """Three views of eight Gaussians."""
    return tiny_scan(geometry())
