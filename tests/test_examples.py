"""Every example runs, at its own small size, as the gallery runs it."""

import runpy
import warnings
from pathlib import Path

import matplotlib
import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / 'examples').glob('[0-9]*.py'))
NEEDS = {'07_pytorch': 'torch'}


def test_there_are_examples():
    assert len(EXAMPLES) >= 8


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_example(path, monkeypatch, tmp_path):
    """Without an error, with a picture, and without a warning of matplotlib or NumPy."""
    if path.stem in NEEDS:
        pytest.importorskip(NEEDS[path.stem])
    matplotlib.use('Agg')
    from matplotlib import pyplot

    monkeypatch.chdir(tmp_path)
    pyplot.close('all')
    with warnings.catch_warnings():
        warnings.simplefilter('error', RuntimeWarning)
        runpy.run_path(str(path), run_name='__main__')
    assert pyplot.get_fignums(), 'an example shows something'
    pyplot.close('all')
