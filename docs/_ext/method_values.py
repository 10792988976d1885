"""`.. methods::` is a table of all options of a fit and their values in every method."""

from docutils import nodes
from docutils.parsers.rst import Directive

from lingo_mi.fitting.methods.by_name import METHODS


class Methods(Directive):
    """Options in rows, methods in columns; what differs from R2-Gaussian's is bold."""

    def run(self):
        names = ('r2', *(name for name in METHODS if name != 'r2'))
        table = nodes.table(classes=['methods'])
        group = nodes.tgroup(cols=1 + len(names))
        group += [nodes.colspec(colwidth=1) for _ in range(1 + len(names))]
        head = nodes.thead()
        head += _row([nodes.Text('option'), *(nodes.literal('', name) for name in names)])
        body = nodes.tbody()
        values = [METHODS[name].flat() for name in names]
        for option in dict.fromkeys(option for of_method in values for option in of_method):
            shown = [_shown(of_method[option]) if option in of_method else '' for of_method in values]
            cells = [nodes.Text(v) if shown[0] in ('', v) else nodes.strong('', v) for v in shown]
            body += _row([nodes.literal('', option), *cells])
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
    app.add_directive('methods', Methods)
    return {'parallel_read_safe': True}
