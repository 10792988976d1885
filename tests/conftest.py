"""Fixtures and options of all tests: the variant, slow tests, and the folder of test volumes."""

import os
import signal
import sys
from pathlib import Path

import pytest

if hasattr(os, 'sched_setaffinity'):
    # Processes of pytest-xdist share the cores: threads that wait for each other's cores take a third more time.
    workers, cpus = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1')), sorted(os.sched_getaffinity(0))
    if 1 < workers <= len(cpus):
        os.sched_setaffinity(0, cpus[int(os.environ['PYTEST_XDIST_WORKER'].removeprefix('gw')) :: workers])

import lingo_mi  # noqa: F401 - before any test module loads Dr.Jit, so that Dr.Jit finds the bundled libLLVM
from helpers.phantoms import made_once
from helpers.same import STAND_IN, adds_in_any_order

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell starts what runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)

os.environ.setdefault('XLA_PYTHON_CLIENT_PREALLOCATE', 'false')  # JAX would take three quarters of a GPU's memory

VARIANT = os.environ.get('LINGO_MI_TEST_VARIANT', 'llvm_ad_mono')


def pytest_addoption(parser):
    parser.addoption('--all', action='store_true', help='also run the thorough tests, which take most of the time')
    parser.addoption('--slow', action='store_true', help='also run the full-size forms of tests')


def pytest_collection_modifyitems(config, items):
    if not (config.getoption('--all') or config.getoption('--slow')):
        thorough = [item for item in items if 'thorough' in item.keywords]
        config.hook.pytest_deselected(items=thorough)
        items[:] = [item for item in items if 'thorough' not in item.keywords]
    skips = {}
    if not config.getoption('--slow'):
        skips['slow'] = 'full size: run with --slow'
    if STAND_IN and VARIANT.startswith('cuda'):
        skips['traces_rays'] = 'a stand-in for the CUDA driver has no OptiX'
    if sys.platform == 'win32':
        skips['posix'] = 'Windows has no such pipes, devices, fork or signals'
    for item in items:
        for name, reason in skips.items():
            if name in item.keywords:
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope='session', autouse=True)
def variant() -> str:
    """The variant under test, LINGO_MI_TEST_VARIANT or llvm_ad_mono, active in every test."""
    from lingo_mi.common.runtime import use_variant

    return use_variant(VARIANT)


@pytest.fixture(scope='session', autouse=True)
def phantoms_made_once():
    """Phantoms are the same arrays in all tests of a process."""
    with made_once():
        yield


@pytest.fixture
def sums_in_order(variant) -> None:
    """Skip the test if additions are in another order than in the program."""
    if adds_in_any_order():
        pytest.skip('a GPU adds atomically, in any order')


@pytest.fixture
def no_report(monkeypatch) -> None:
    """Results are written without their report, which takes longer to draw than a small fit."""
    monkeypatch.setattr('lingo_mi.fitting.save.write_report', lambda *_: None)


@pytest.fixture(scope='session')
def data() -> Path:
    """The folder of test volumes that LINGO_MI_DATA names; tests are skipped if it names none."""
    folder = os.environ.get('LINGO_MI_DATA')
    if not folder or not Path(folder).is_dir():
        pytest.skip('LINGO_MI_DATA names no folder of test volumes')
    return Path(folder)


@pytest.fixture(scope='module')
def scene(tmp_path_factory) -> Path:
    """A file of a scene that fits in a second."""
    from helpers.script import SCENE

    path = tmp_path_factory.mktemp('scene') / 'tiny.xml'
    path.write_text(SCENE)
    return path
