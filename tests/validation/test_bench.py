"""`lingo-mi bench` on a few Gaussians."""

import json

import pytest

from helpers.script import run

BENCH = 'bench'
KEYS = (
    'forward_ns_per_pair',
    'backward_ns_per_pair',
    'limit_forward_ns_per_pair',
    'limit_backward_ns_per_pair',
    'bvh_forward_ms',
    'bvh_backward_ms',
    'forward_ms',
    'backward_ms',
)


@pytest.mark.traces_rays
def test_all_numbers_are_there(tmp_path):
    few = '--gaussians', 50, '--size', 32, '--pixels', 40, '--repeats', 1, '--json', tmp_path / 'a.json'
    code, out, err = run(BENCH, *few)
    record = json.loads((tmp_path / 'a.json').read_text())
    assert code == 0, err
    measured = [
        record[key] for key in KEYS if record[key] is not None or not key.startswith('limit')
    ]  # no g++: no limit
    assert min(measured) > 0 and 'times ours' in out
    assert record['image_error'] < 0.02 and record['gradient_error'] < 0.1
    assert run(BENCH, *few, '--no-bvh')[0] == 0
    record = json.loads((tmp_path / 'a.json').read_text())
    assert [record[key] for key in KEYS if key.startswith('bvh')] == [None, None]


@pytest.mark.parametrize(
    'args', [('--gaussians', 0), ('--size', 0), ('--pixels', 1e6), ('--extent', 0), ('--repeats', 'x')]
)
def test_bad_input(args):
    code, out, err = run(BENCH, *args)
    assert code == 2 and err.startswith('error: ') and err.count('\n') == 1 and not out
