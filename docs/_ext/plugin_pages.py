"""Reference of the Mitsuba plugins from their docstrings, which are in the style of Mitsuba's own documentation.

    .. plugin:: lingo_xray

is the docstring of `plugins/lingo_xray.py`: of the first class or function that has one with a `.. pluginparameters::` or a
label. The source is parsed, not imported, so no Mitsuba variant is needed.
"""

import ast
import inspect
import re
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.parsers.rst.directives.tables import ListTable
from docutils.statemachine import StringList
from sphinx.util.nodes import nested_parse_with_titles

PLUGINS = Path(__file__).resolve().parents[2] / 'plugins'
TYPES = ('float', 'int', 'boolean', 'string', 'transform', 'spectrum', 'texture')


class PluginParameters(ListTable):
    """Rows of name, type and meaning, with a head."""

    def run(self):
        self.options.setdefault('header-rows', 1)
        self.options.setdefault('widths', [18, 14, 68])
        self.options.setdefault('class', ['plugin-parameters'])
        source = self.content.source(0) if self.content else ''
        head = StringList(['* - Parameter', '  - Type', '  - Meaning'], source=source)
        self.content = head + self.content
        return super().run()


class Plugin(Directive):
    """The docstring of a plugin, as sections of the page."""

    required_arguments = 1

    def run(self):
        path = PLUGINS / f'{self.arguments[0]}.py'
        self.state.document.settings.env.note_dependency(str(path))
        lines = linked(docstring(path)).splitlines()
        node = nodes.section()
        node.document = self.state.document
        nested_parse_with_titles(self.state, StringList(lines, source=str(path)), node)
        return node.children


def docstring(path: Path) -> str:
    """The docstring in a file that begins with a label, as Mitsuba's do. Raises ValueError where there is none."""
    for item in ast.parse(path.read_text(encoding='utf-8')).body:
        if isinstance(item, (ast.ClassDef, ast.FunctionDef)):
            text = inspect.cleandoc(ast.get_docstring(item, clean=False) or '')
            if text.startswith('.. _'):
                return text
    raise ValueError(f'{path}: no class or function has a docstring that begins with a label')


def linked(text: str) -> str:
    """A docstring whose mentions of docs/NAME.md are links to that page."""
    return re.sub(r'docs/(\w+)\.md', r':doc:`/\1`', text)


def monospace(name, rawtext, text, lineno, inliner, options=None, content=()):
    return [nodes.literal(rawtext, text)], []


def substitutions(app, document_name, source):
    """`|float|` and the like in reStructuredText pages."""
    if Path(app.env.doc2path(document_name)).suffix == '.rst':
        source[0] += '\n\n' + '\n'.join(f'.. |{name}| replace:: :monosp:`{name}`' for name in TYPES) + '\n'


def setup(app):
    app.add_directive('pluginparameters', PluginParameters)
    app.add_directive('plugin', Plugin)
    app.add_role('monosp', monospace)
    app.connect('source-read', substitutions)
    return {'parallel_read_safe': True}
