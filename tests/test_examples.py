"""Every example runs, with short fits and small panels: the gallery of the documentation runs them in full."""

import ast
import json
import runpy
import warnings
from pathlib import Path

import matplotlib
import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.phantoms import x3d_scan

EXAMPLES = sorted((Path(__file__).parents[1] / 'examples').glob('[0-9]*.py'))
NEEDS = {
    '06_spectrum_and_detector': ('spekpy', 'xraylib'),
    '07_pytorch': ('torch',),
    '13_deepinv': ('torch', 'deepinv'),
    '14_odl': ('odl',),
    '15_unrolled': ('torch',),
}
QUICK = '01_first_fit', '06_spectrum_and_detector', '08_mitsuba_scene', '09_gradient_check'


def marked(path):
    return pytest.param(path, id=path.stem, marks=() if path.stem in QUICK else pytest.mark.thorough)


def is_name(node):
    """Return whether a statement is a name alone, which a notebook shows."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Name)


def test_there_are_examples():
    assert len(EXAMPLES) >= 8


@pytest.mark.parametrize('path', [marked(path) for path in EXAMPLES])
def test_example(path, variant, monkeypatch, tmp_path):
    """Each example runs with something to see, without an error, and without a warning of matplotlib or NumPy."""
    for module in NEEDS.get(path.stem, ()):
        optional = pytest.importorskip(module)
        if module == 'torch' and variant.startswith('cuda') and not optional.cuda.is_available():
            pytest.skip('PyTorch has no GPU')
    matplotlib.use('Agg')
    from matplotlib import pyplot

    fit, scanner = lm.fit, x3d_scan.default_geometry
    monkeypatch.setattr(lm, 'fit', lambda *scan, **settings: fit(*scan, **settings | {'iterations': 20}))
    monkeypatch.setattr(x3d_scan, 'default_geometry', lambda phantom, angles, pixels: scanner(phantom, angles, 128))
    monkeypatch.chdir(tmp_path)
    pyplot.close('all')
    with warnings.catch_warnings(), np.printoptions():  # which ODL changes for good
        warnings.simplefilter('error', RuntimeWarning)
        names = runpy.run_path(str(path), run_name='__main__')
    lm.use_variant(variant)  # which an example may change
    shown = [names[node.value.id] for node in ast.parse(path.read_text(encoding='utf-8')).body if is_name(node)]
    assert all('<figure' in display or '<svg' in display for display in (optional._repr_html_() for optional in shown))
    assert shown or pyplot.get_fignums(), 'an example shows something'
    pyplot.close('all')


def test_the_notebook_is_the_first_tutorial():
    """It has outputs, and a first cell that installs the package; `python docs/make_notebook.py` makes it."""
    path = EXAMPLES[0].with_name('first_fit.ipynb')
    cells = [cell for cell in json.loads(path.read_text(encoding='utf-8'))['cells'] if cell['cell_type'] == 'code']
    assert 'pip install' in ''.join(cells[0]['source'])
    code = '\n'.join(''.join(cell['source']) for cell in cells[1:])
    tutorial = ast.parse(EXAMPLES[0].read_text(encoding='utf-8'))
    assert ast.dump(ast.parse(code)) == ast.dump(ast.Module(tutorial.body[1:], []))  # without its title
    outputs = [output for cell in cells[1:] for output in cell['outputs']]
    assert len(outputs) > 4 and all(output['output_type'] != 'error' for output in outputs)
    assert path.stat().st_size < 500_000
