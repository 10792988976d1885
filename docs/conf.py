"""Sphinx's settings: `python -m sphinx -W -b html docs build/site` builds the site, warnings being errors."""

import importlib.metadata
import importlib.util
import os
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS / '_ext'), str(DOCS.parent)]
os.environ.setdefault('COLUMNS', '100')  # width of the command line's help

import lingo_mi  # noqa: E402 - from the folder above
from lingo_mi.common.progress import Progress  # noqa: E402

project = 'lingo_mi'
author = 'the lingo_mi developers'
copyright = f'2026, {author}'
try:
    release = importlib.metadata.version('lingo_mi')
except importlib.metadata.PackageNotFoundError:
    release = lingo_mi.__version__


extensions = [
    'myst_parser',
    'sphinx.ext.autodoc',
    'mathml',
    'gallery_links',
    'sphinx_gallery.gen_gallery',
    'plain_docstrings',
    'plugin_pages',
    'command_help',
    'method_values',
]
exclude_patterns = ['_ext', 'gallery/**/*.md5', 'gallery/**/*.json', 'gallery/**/*.ipynb', 'gallery/**/*.py']

myst_enable_extensions = ['dollarmath', 'deflist', 'colon_fence']
myst_heading_anchors = 3
default_role = 'py:obj'  # `name` links to what it names, where that is documented
autodoc_typehints = 'signature'
autodoc_member_order = 'bysource'
autodoc_preserve_defaults = True
autodoc_type_aliases = {'ArrayLike': 'ArrayLike'}  # whose definition is many lines long
add_module_names = False
python_maximum_signature_line_length = 100

Progress._draw = lambda self, now: None  # pages show what examples print, not how far they are

# What examples need besides the package. Where it is missing, they are shown without what they print and draw.
NEEDS = {
    '06_spectrum_and_detector': ('spekpy', 'xraylib'),
    '07_pytorch': ('torch',),
    '13_deepinv': ('deepinv',),
    '14_odl': ('odl',),
    '15_unrolled': ('torch',),
}
skipped = []
for example, modules in NEEDS.items():
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        skipped.append(example)
        print(f'examples/{example}.py is shown without its output: install {", ".join(missing)}', file=sys.stderr)

sphinx_gallery_conf = {
    'examples_dirs': '../examples',
    'gallery_dirs': 'gallery',
    'filename_pattern': r'[/\\]' + ''.join(f'(?!{example})' for example in skipped) + r'\d\d_',
    'capture_repr': ('_repr_html_',),  # scans and results show themselves, as in a notebook
    'download_all_examples': False,
    'show_memory': False,
    'write_computation_times': False,
    'show_signature': False,
    'remove_config_comments': True,
    'within_subsection_order': 'FileNameSortKey',
    'image_scrapers': ('matplotlib',),
    'plot_gallery': 'True',
    'abort_on_example_error': True,
}

html_math_renderer = 'mathml'
html_theme = 'furo'
html_title = 'lingo_mi'
html_static_path = ['_static']
html_css_files = ['site.css']
html_copy_source = False
html_show_sphinx = False
html_theme_options = {'sidebar_hide_name': False, 'navigation_with_keys': True}
