"""Makes examples/first_fit.ipynb, the first tutorial as a notebook with its outputs, from examples/01_first_fit.py.

pip install -e '.[docs]' nbclient ipykernel && python docs/make_notebook.py
"""

from collections import defaultdict
from itertools import count
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from sphinx_gallery.notebook import rst2md
from sphinx_gallery.py_source_parser import split_code_and_text_blocks

EXAMPLES = Path(__file__).parents[1] / 'examples'
TUTORIAL, NOTEBOOK = EXAMPLES / '01_first_fit.py', EXAMPLES / 'first_fit.ipynb'
LARGEST = 300_000  # characters of an output
INSTALL = """\
import importlib.util

if importlib.util.find_spec('lingo_mi') is None:  # on Colab; on Binder it is installed
    %pip install --quiet lingo_mi"""


def cells() -> list:
    """The blocks of the tutorial behind a cell that installs the package."""
    out, level = [nbformat.v4.new_code_cell(INSTALL)], count(1)
    levels = defaultdict(lambda: next(level))  # of headings, in the order in which their underlines come
    for kind, text, _ in split_code_and_text_blocks(str(TUTORIAL))[1]:
        if kind == 'text':
            out.append(nbformat.v4.new_markdown_cell(rst2md(text, {}, str(EXAMPLES), levels).strip()))
        elif text.strip():
            out.append(nbformat.v4.new_code_cell(text.strip()))
    out[0], out[1] = out[1], out[0]  # the title comes first
    for number, cell in enumerate(out):
        cell['id'] = f'cell-{number}'  # the same at every run
    return out


def trim(notebook) -> None:
    """Leave out how far a run was, and what is too large for a file in a repository: whoever runs the cell sees it."""
    for cell in notebook.cells:
        if cell.cell_type == 'code':
            cell.outputs = [output for output in cell.outputs if output.get('name') != 'stderr']
            for output in cell.outputs:
                if len(output.get('data', {}).get('text/html', '')) > LARGEST:
                    del output.data['text/html']


def main() -> None:
    kernel = dict(name='python3', display_name='Python 3', language='python')
    notebook = nbformat.v4.new_notebook(cells=cells(), metadata=dict(kernelspec=kernel))
    NotebookClient(notebook, timeout=1200, record_timing=False).execute()
    trim(notebook)
    notebook.metadata.pop('language_info')  # the version of Python here
    nbformat.write(notebook, NOTEBOOK)
    print(f'{NOTEBOOK}: {NOTEBOOK.stat().st_size / 1e3:.0f} kB')


if __name__ == '__main__':
    main()
