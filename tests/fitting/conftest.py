"""A scan for the tests of fits, and fits of it."""

import pytest

from helpers.fits import SHORT, geometry, tiny_scan


@pytest.fixture(scope='module')
def scan():
    """Three views of eight Gaussians."""
    return tiny_scan(geometry())


@pytest.fixture(scope='module')
def whole(scan):
    """An uninterrupted fit."""
    from lingo_mi.fitting.loop import run

    return run(scan, SHORT, seed=3)


@pytest.fixture
def stored(scan, tmp_path):
    """The checkpoint of a fit of two steps."""
    from lingo_mi.fitting.loop import run

    path = tmp_path / 'fit.npz'
    run(scan, SHORT.changed(iterations=2), path=path)
    return path
