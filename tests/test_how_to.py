"""The code of how-to pages runs as it stands, the blocks of a page one after another."""

import re
from pathlib import Path

import pytest

HOW_TO = Path(__file__).parents[1] / 'docs' / 'how_to'


@pytest.mark.parametrize('page', ['pytorch', 'scipy'])
def test_the_code_of_a_page(page, variant):
    blocks = re.findall(
        '^```python\n(.*?)^```', (HOW_TO / f'{page}.md').read_text(encoding='utf-8'), re.DOTALL | re.MULTILINE
    )
    assert blocks
    if page == 'pytorch' and variant.startswith('cuda') and not pytest.importorskip('torch').cuda.is_available():
        pytest.skip('PyTorch has no GPU')
    names = {}
    for block in blocks:
        try:
            exec(block, names)
        except ModuleNotFoundError as missing:
            pytest.skip(str(missing))
