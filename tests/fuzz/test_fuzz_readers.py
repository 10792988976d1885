"""Mutated files: a share of what `lingo-mi fuzz` reads, shrunk where one fails."""

from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lingo_mi.studies.fuzz.child import verdict
from lingo_mi.studies.fuzz.pool import run
from lingo_mi.studies.fuzz.readers import NAMES, reader, write

CHEAP = tuple(name for name in NAMES if name != 'scene')


@pytest.mark.parametrize('name', CHEAP)
def test_the_good_files_are_read(tmp_path, name):
    """Otherwise nothing but the first check would see the mutated ones."""
    read, samples = reader(name)
    for index, sample in enumerate(samples):
        write(sample, tmp_path / str(index))
        if name != 'raw':  # whose shape is drawn, too
            read(tmp_path / str(index) / sample.target, Random(0))


@pytest.mark.parametrize('name', CHEAP)
@settings(
    max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(rng=st.randoms(use_true_random=False))
def test_mutated_files_in_this_process(tmp_path, name, rng):
    assert verdict(name, tmp_path, rng) in ('value', 'refused')


@pytest.mark.parametrize('cases', [20, pytest.param(5000, marks=pytest.mark.slow)])
def test_mutated_files_in_children(cases):
    """Under a limit of time and memory; also scenes, whose reader is not Python alone."""
    tallies = run(NAMES, cases, seed=1)
    failures = {name: tally.failures for name, tally in tallies.items() if tally.failures}
    assert not failures
    assert all(tally.cases == cases for tally in tallies.values())
    assert sum(tally.values for tally in tallies.values()) > cases  # not everything is refused at the first byte


SAVED = Path(__file__).parent / 'cases'


@pytest.mark.parametrize('folder', sorted(SAVED.glob('*')) if SAVED.exists() else [], ids=lambda path: path.name)
def test_files_that_once_failed(folder):
    """None yet that no other test holds."""
