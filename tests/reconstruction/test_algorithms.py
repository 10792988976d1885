"""Algorithms as objects: options and their checks, what `run` and `reconstruct` take and give, the examples of their docs."""

import doctest
import importlib
from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest

import lingo_mi as lm
from helpers.algorithms import ITERATIVE
from helpers.grids import scan as small
from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.grid import project_volume
from lingo_mi.reconstruction import ALGORITHMS, CGLS, FDK, SART, Reconstruction, Refined, progress_bar
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan

FAST = dict(niter=2, completed_niter=0, tviter=2, strength=1e-3)  # of those that have it


def quick(name):
    """An algorithm of few steps."""
    made = ALGORITHMS[name]
    return made(**{option: value for option, value in FAST.items() if option in made().options})


def inputs(name, scan):
    """Return the inputs that `run` of this algorithm needs."""
    return dict(start=np.ones(scan.geometry.grid.shape)) if name == 'refined' else {}


@pytest.fixture(scope='module')
def scan():
    geometry = small(n=5)
    return Scan(geometry, project_volume(np.random.default_rng(0).random(geometry.grid.shape), geometry))


@pytest.mark.parametrize('name', ALGORITHMS)
def test_what_comes_back(scan, name):
    result = run_algorithm(scan, quick(name), **inputs(name, scan))
    assert isinstance(result, Reconstruction) and result.grid == scan.geometry.grid
    assert result.volume.dtype == np.float32 and result.volume.shape == scan.geometry.grid.shape
    assert result.seconds > 0
    if name != 'best':  # it chooses its passes
        assert len(result.residuals) == (0 if name == 'fdk' else 3)


def test_as_an_array(scan):
    result = run_algorithm(scan, FDK())
    assert np.asarray(result) is result.volume
    assert np.asarray(result, np.float64).dtype == np.float64 and np.mean(result) == np.mean(result.volume)
    copied = np.array(result)
    copied[:] = 0
    assert result.volume.any()


@pytest.mark.parametrize('name', ITERATIVE)
def test_a_start_is_anything_that_gives_an_array(scan, name):
    first, algorithm = run_algorithm(scan, FDK()), quick(name)
    result = run_algorithm(scan, algorithm, start=first.volume)
    assert np.abs(result.volume - run_algorithm(scan, algorithm).volume).max() > 1e-4
    for start in (first, first.volume.astype(float), first.volume.tolist()):
        again = run_algorithm(scan, algorithm, start=start)
        np.testing.assert_array_equal(again, result)
    assert result.residuals[0] == again.residuals[0] < 1


def test_options_are_fields(scan):
    for name, algorithm in ALGORITHMS.items():
        made = algorithm()
        assert made.name == name and list(made.options) == [f.name for f in fields(algorithm)]
        assert algorithm(**made.options) == made
        with pytest.raises(FrozenInstanceError):
            setattr(made, next(iter(made.options)), 0)
    assert SART(niter=3) == replace(SART(), niter=3) != SART()


def test_defaults_are_tigres():
    """They are TIGRE 2's defaults for Python; the order of views is the default for MATLAB."""
    sweeps = dict(lmbda=1.0, lmbda_red=0.99, noneg=True)
    descent = dict(tviter=20, alpha=0.002, alpha_red=0.95, rmax=0.95)
    expected = {
        'sart': sweeps | dict(OrderStrategy='random'),
        'os-sart': sweeps | dict(blocksize=20, OrderStrategy='random'),
        'sirt': sweeps,
        'asd-pocs': sweeps | descent | dict(blocksize=1, OrderStrategy='random'),
    }
    for name, values in expected.items():
        options = ALGORITHMS[name]().options
        assert values == {option: options[option] for option in values}, name


def test_iterations_by_default():
    """The numbers are our own, and the tables in the docs are made with them."""
    expected = {
        'sart': 20,
        'os-sart': 50,
        'sirt': 100,
        'cgls': 20,
        'asd-pocs': 50,
        'pls': 60,
        'refined': 20,
        'best': 20,
    }
    assert expected == {n: a().options['niter'] for n, a in ALGORITHMS.items() if 'niter' in a().options}


@pytest.mark.parametrize(
    'name, wrong, says',
    [
        ('fdk', dict(filter='box'), "filter 'box' is unknown: use one of ram-lak, shepp-logan, cosine, hamming, hann"),
        ('sart', dict(niter=0), 'niter must be an integer from 1 on, not 0'),
        ('sart', dict(niter='3'), "niter must be an integer from 1 on, not '3'"),
        ('sart', dict(niter=True), 'niter must be an integer from 1 on, not True'),
        ('sart', dict(lmbda=None), 'lmbda must be above 0 and at most 2, not None'),
        ('sart', dict(tol='0'), "tol must be from 0 to 1e+18, not '0'"),
        ('sart', dict(lmbda=2.5), 'lmbda must be above 0 and at most 2, not 2.5'),
        ('sart', dict(lmbda_red=0), 'lmbda_red must be above 0 and at most 1, not 0'),
        ('asd-pocs', dict(lmbda_red=1.1), 'lmbda_red must be above 0 and at most 1, not 1.1'),
        (
            'sart',
            dict(OrderStrategy='any'),
            "OrderStrategy 'any' is unknown: use one of ordered, random, angularDistance",
        ),
        ('sart', dict(seed=-1), 'seed must be an integer from 0 on, not -1'),
        ('os-sart', dict(blocksize=0), 'blocksize must be an integer from 1 on, not 0'),
        ('os-sart', dict(tol=-1), 'tol must be from 0 to 1e+18, not -1'),
        ('sirt', dict(niter=1.5), 'niter must be an integer from 1 on, not 1.5'),
        ('sirt', dict(tol=np.nan), 'tol must be from 0 to 1e+18, not nan'),
        ('cgls', dict(tol=np.inf), 'tol must be from 0 to 1e+18, not inf'),
        ('asd-pocs', dict(rmax=0), 'rmax must be above 0 and at most 1e+18, not 0'),
        ('asd-pocs', dict(tviter=0), 'tviter must be an integer from 1 on, not 0'),
        ('asd-pocs', dict(OrderStrategy='any'), "OrderStrategy 'any' is unknown"),
        ('refined', dict(finer=0), 'finer must be an integer from 1 on, not 0'),
        ('refined', dict(completed_niter=-1), 'completed_niter must be an integer from 0 on, not -1'),
        ('best', dict(niter=0), 'niter must be an integer from 1 on, not 0'),
        ('best', dict(finer=1.5), 'finer must be an integer from 1 on, not 1.5'),
        ('best', dict(held_out=1), 'held_out must be an integer from 2 on, not 1'),
        ('refined', dict(alpha=0), 'alpha must be above 0 and at most 1e+18, not 0'),
    ],
)
def test_options_are_checked_at_once(name, wrong, says):
    with pytest.raises(InputError) as error:
        ALGORITHMS[name](**wrong)
    assert str(error.value).startswith(says)


def test_what_a_run_needs(scan):
    volume = np.ones(scan.geometry.grid.shape)
    with pytest.raises(InputError, match='leave out start'):
        run_algorithm(scan, FDK(), start=volume)
    with pytest.raises(InputError, match='completed_niter must be 0 if no completed views are given'):
        run_algorithm(scan, Refined(), start=volume)
    refined = quick('refined')
    for arrays in ({}, dict(start=volume, sample=lambda _: volume)):
        with pytest.raises(InputError, match='give it as start, or a function for it as sample'):
            run_algorithm(scan, refined, **arrays)
    with pytest.raises(InputError, match='give the fit as start'):
        run_algorithm(scan, replace(refined, finer=2), start=volume)
    with pytest.raises(InputError, match='the start volume: shape'):
        run_algorithm(scan, refined, start=volume[1:])
    by_start = run_algorithm(scan, refined, start=volume)
    np.testing.assert_array_equal(
        by_start, run_algorithm(scan, refined, sample=lambda grid: np.ones(grid.shape, np.float32))
    )


@pytest.mark.parametrize('name', ALGORITHMS)
def test_progress_counts_the_steps(scan, name):
    algorithm, calls = quick(name), []
    run_algorithm(scan, algorithm, progress=lambda *call: calls.append(call), **inputs(name, scan))
    assert calls[-1][:2] == (algorithm.steps(scan),) * 2 and [done for done, _, _ in calls] == sorted(
        t[0] for t in calls
    )
    residuals = [residual for _, _, residual in calls]
    assert all(residual is None or residual > 0 for residual in residuals)
    if name not in ('fdk', 'asd-pocs', 'refined'):  # FDK has none, the others one where it decides
        assert residuals[-1] > 0
    if 'tol' in algorithm.options:
        calls.clear()
        run_algorithm(scan, replace(algorithm, tol=1e-9), progress=lambda *call: calls.append(call))
        assert all(residual > 0 for _, _, residual in calls)


def test_progress_of_both_stages(scan):
    calls, refined = [], Refined(niter=2, completed_niter=1, tviter=2)
    few = scan.subset([0, 2])
    run_algorithm(
        few, refined, progress=lambda *call: calls.append(call), start=np.ones(scan.geometry.grid.shape), completed=scan
    )
    assert [call[:2] for call in calls] == [(1, 3), (2, 3), (3, 3)] and calls[0][2] is None


def test_a_bar(scan, capsys):
    algorithm = CGLS(niter=2)
    with progress_bar(algorithm, scan) as progress:
        run_algorithm(scan, algorithm, progress=progress)
    text = capsys.readouterr().err
    assert 'cgls: 2/2 (100%)' in text and 'residual' in text
    with progress_bar(FDK(), scan, 'first look') as progress:
        run_algorithm(scan, FDK(), progress=progress)
    assert 'first look: 5/5 (100%)' in capsys.readouterr().err


@pytest.mark.parametrize(
    'name', [pytest.param(n, marks=pytest.mark.thorough) if n == 'best' else n for n in ALGORITHMS]
)  # `best` by command is its run, too
def test_the_front_door_is_the_run(scan, name):
    arrays = inputs(name, scan)
    result = lm.reconstruct(scan, quick(name), progress=False, **arrays)
    np.testing.assert_array_equal(result, run_algorithm(scan, quick(name), **arrays))


def test_reconstruct_takes_line_integrals_only(scan):
    saturated, counted = (Detector.of(**(Detector.DEFAULTS | o)) for o in (dict(saturation=0.5), dict(photons=1e4)))
    with pytest.raises(InputError, match=r'not line integrals.* take line_integrals\(scan\)'):
        run_algorithm(replace(scan, effects=Effects(detector=saturated)), FDK())
    linear = line_integrals(replace(scan, effects=Effects(detector=saturated)))
    assert linear.effects is None and line_integrals(linear) is linear
    run_algorithm(linear, FDK())
    ideal = replace(scan, effects=Effects(detector=counted))
    np.testing.assert_array_equal(run_algorithm(ideal, FDK()), run_algorithm(scan, FDK()))


def test_reconstruct_asks_first(scan, monkeypatch):
    g = scan.geometry
    with pytest.raises(InputError, match='zero everywhere'):
        run_algorithm(replace(scan, projections=0 * scan.projections), FDK())
    with pytest.raises(InputError, match='nowhere above zero'):
        run_algorithm(replace(scan, projections=-scan.projections), FDK())
    with pytest.raises(InputError, match='no ray meets the volume'):
        lm.reconstruct(replace(scan, geometry=g.on(replace(g.grid, centre=(0.0, 0.0, 1000.0)))), FDK())
    with pytest.raises(InputError, match='source lies within the volume'):
        lm.reconstruct(replace(scan, geometry=replace(g, DSO=5.0)), FDK())
    volume = 4 * np.prod(g.grid.shape)
    projections = 4 * scan.projections.size
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 3.5 * volume + 8 * projections)
    assert run_algorithm(scan, FDK()).volume.any()
    start = np.ones(g.grid.shape)
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 20 * volume + 8 * projections)
    refined = quick('refined')
    run_algorithm(scan, refined, start=start)
    with pytest.raises(InputError, match='18 x 22 x 14 voxels and 5 views'):  # of those that it works on
        run_algorithm(scan, replace(refined, finer=2), sample=lambda geometry: np.ones(geometry.grid.shape))
    many = Scan(Geometry.joined(g, small(n=200)), np.concatenate([scan.projections, np.ones((200, *g.nDetector))]))
    with pytest.raises(InputError, match='205 views'):
        run_algorithm(scan, replace(refined, completed_niter=1), start=start, completed=many)


@pytest.mark.parametrize('name', ALGORITHMS)
def test_documentation(name):
    """The examples run, and every option is described."""
    algorithm = ALGORITHMS[name]
    module = importlib.import_module(algorithm.__module__)
    doctests = doctest.DocTestFinder(recurse=False).find(algorithm, algorithm.__name__, globs=dict(vars(module)))
    runner = doctest.DocTestRunner()
    assert doctests[0].examples and runner.run(doctests[0]).failed == 0
    words = algorithm.__doc__.replace(',', ' ').split()
    assert all(option in words for option in algorithm().options)


@pytest.mark.parametrize('name', [name for name in ALGORITHMS if name != 'refined'])
def test_projections_spoilt_after_the_scan_was_made(scan, name):
    spoilt = replace(scan, projections=scan.projections.copy())
    spoilt.projections[3, 0, 0] = np.nan
    with pytest.raises(InputError, match='first in view 3'):
        run_algorithm(spoilt, quick(name))
