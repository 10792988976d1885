"""The code of how-to pages runs as it stands, the blocks of a page one after another."""

import re
from pathlib import Path

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.files.scans import write_scan

HOW_TO = Path(__file__).parents[1] / 'docs' / 'how_to'


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A small scan and its object, in the files that pages name, in the working directory."""
    monkeypatch.chdir(tmp_path)
    geometry = lm.Geometry.cone(
        DSO=1000, DSD=1500, nDetector=(12, 12), dDetector=36, nVoxel=8, dVoxel=24, angles=lm.circular(6, 360)
    )
    volume = np.zeros(geometry.grid.shape, np.float32)
    volume[2:6, 2:5, 3:6] = 0.02
    np.save('volume.npy', volume)
    write_scan('scan.npy', lm.Scan(geometry, lm.Projector(geometry)(volume)), 'npy')


@pytest.mark.parametrize('page', ['denoiser', 'operator', 'poses', 'pytorch', 'scipy'])
def test_the_code_of_a_page(page, variant, files):
    blocks = re.findall(
        '^```python\n(.*?)^```', (HOW_TO / f'{page}.md').read_text(encoding='utf-8'), re.DOTALL | re.MULTILINE
    )
    assert blocks
    if (
        page in ('poses', 'pytorch')
        and variant.startswith('cuda')
        and not pytest.importorskip('torch').cuda.is_available()
    ):
        pytest.skip('PyTorch has no GPU')
    names = {}
    for block in blocks:
        try:
            exec(block, names)
        except ModuleNotFoundError as missing:
            pytest.skip(str(missing))
