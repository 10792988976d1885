"""`.. recipes::` is a table of all settings of a fit and their values in every recipe."""

from docutils import nodes
from docutils.parsers.rst import Directive

from lingo_mi.fitting.recipes import METHODS


class Recipes(Directive):
    """Settings in rows, recipes in columns; what differs from R2-Gaussian's, the default, is bold."""

    def run(self):
        names = ('r2', *(name for name in METHODS if name != 'r2'))
        table = nodes.table(classes=['recipes'])
        group = nodes.tgroup(cols=1 + len(names))
        group += [nodes.colspec(colwidth=1) for _ in range(1 + len(names))]
        head = nodes.thead()
        head += _row([nodes.Text('setting'), *(nodes.literal('', name) for name in names)])
        body = nodes.tbody()
        recipes = [METHODS[name].flat() for name in names]
        for setting in recipes[0]:
            values = [_shown(recipe[setting]) for recipe in recipes]
            cells = [nodes.Text(v) if v == values[0] else nodes.strong('', v) for v in values]
            body += _row([nodes.literal('', setting), *cells])
        group += [head, body]
        table += group
        return [table]


def _row(cells):
    row = nodes.row()
    for cell in cells:
        row += nodes.entry('', nodes.paragraph('', '', cell))
    return row


def _shown(value) -> str:
    """A value as it is given on the command line."""
    if isinstance(value, tuple):
        return ', '.join(map(_shown, value))
    if isinstance(value, (bool, str)):
        return str(value).lower()
    return f'{value:,}' if isinstance(value, int) else f'{value:g}'


def setup(app):
    app.add_directive('recipes', Recipes)
    return {'parallel_read_safe': True}
