"""Mutated files: a share of what `python -m studies.fuzz` reads, shrunk where one fails."""

import sys
import zipfile
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.checkpoint import Checkpoint
from studies.fuzz import corpus, pool
from studies.fuzz.child import verdict
from studies.fuzz.page import page
from studies.fuzz.pool import Tally, run, save_case
from studies.fuzz.readers import NAMES, reader, write

CHEAP = tuple(name for name in NAMES if name != 'scene')


@pytest.mark.parametrize('name', CHEAP)
def test_the_good_files_are_read(tmp_path, name):
    """Otherwise the readers' first check would refuse all mutated ones."""
    if name in ('ome-zarr', 'zarr, yml'):
        pytest.importorskip('zarr')
    read, samples = reader(name)
    for index, sample in enumerate(samples):
        write(sample, tmp_path / str(index))
        if name != 'raw':  # whose shape is drawn, too
            read(tmp_path / str(index) / sample.target, Random(0))


@pytest.mark.parametrize('name', CHEAP)
@settings(max_examples=15, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rng=st.randoms(use_true_random=False))
def test_mutated_files_in_this_process(tmp_path, name, rng):
    assert verdict(name, tmp_path, rng) in ('value', 'refused')


@pytest.mark.parametrize(
    'cases', [10, pytest.param(40, marks=pytest.mark.thorough), pytest.param(5000, marks=pytest.mark.slow)]
)
def test_mutated_files_in_children(cases):
    """Children read them within limits of time and memory, also scenes, whose reader is not Python alone."""
    tallies = run(NAMES, cases, seed=1)
    failures = {name: tally.failures for name, tally in tallies.items() if tally.failures}
    assert not failures
    assert all(tally.cases == cases for tally in tallies.values())
    assert sum(tally.values for tally in tallies.values()) > cases  # not everything is refused at the first byte


def test_an_entry_of_a_checkpoint_whose_header_has_no_end(tmp_path):
    """NumPy asks Python's tokenizer, which has an exception of its own. Mutation found the case."""
    content = corpus.others()['checkpoint'][0].files['c.npz'].content()
    (tmp_path / 'c.npz').write_bytes(content)
    with zipfile.ZipFile(tmp_path / 'c.npz') as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members['born.npy'] = members['born.npy'].replace(b'}', b'(')
    (tmp_path / 'c.npz').write_bytes(corpus.zipped(members))
    with pytest.raises(InputError, match='not an array'):
        Checkpoint.load(tmp_path / 'c.npz')


def test_a_case_is_made_again_from_its_number(tmp_path):
    first, second = (save_case('mha, mhd', 3, 7, 'why', tmp_path / name) for name in ('a', 'b'))
    files = [{p.name: p.read_bytes() for p in (home / 'files').iterdir()} for home in (first, second)]
    assert files[0] == files[1] and 'why' in (first / 'what.txt').read_text()


@pytest.mark.posix
@pytest.mark.parametrize(
    'program, match',
    [
        ('import os; os.kill(os.getpid(), 11)', 'died, exit code -11'),
        ('import time; time.sleep(60)', 'no answer within 1'),
    ],
)
def test_crashes_and_hangs_are_failures_of_their_case(monkeypatch, program, match):
    """A stand-in for the child reads case 0, and stops in case 1; the next one reads the rest."""
    begin = "print('start 0\\nend 0 value\\nstart 1', flush=True); "
    rest = "print('start 2\\nend 2 refused', flush=True); input()"
    programs = iter([f'input(); {begin}{program}', f'input(); {rest}'])
    monkeypatch.setattr(pool, '_command', lambda memory: [sys.executable, '-c', next(programs)])
    tally = run(['npy'], 3, 0, processes=1, seconds=1)['npy']
    assert (tally.values, tally.refused) == (1, 1) and list(tally.failures) == [1] and match in tally.failures[1]


def test_the_page():
    text = page({'npy': Tally(values=3, refused=2, seconds=0.5, failures={4: 'x'})}, 7, 1.5, 10, 2**30)
    assert '| npy | 6 | 3 | 2 | 1 | 12 |' in text and 'seed 7' in text and '1 failed' in text
