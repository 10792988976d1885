"""Formulas as MathML, which browsers draw by themselves: no script from elsewhere is loaded."""

from docutils import nodes
from latex2mathml.converter import convert


def _visit(display: str):
    def visit(self, node):
        formula = convert(node.astext(), display=display)
        self.body.append(f'<div class="formula">{formula}</div>' if display == 'block' else formula)
        raise nodes.SkipNode

    return visit


def setup(app):
    app.add_html_math_renderer('mathml', (_visit('inline'), None), (_visit('block'), None))
    return {'parallel_read_safe': True}
