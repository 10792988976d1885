"""A page as text: the files of `web/` with the contents of a report in their places."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from functools import cache
from importlib.resources import files
from string import Template

from lingo_mi.report.packing import Arrays

STYLES = 'vendor/uPlot.min.css', 'page.css'
LIBRARIES = 'vendor/uPlot.iife.min.js', 'vendor/three.min.js'
SCRIPTS = (
    'elements.js', 'decode.js', 'colours.js', 'curves.js', 'probe.js', 'slices.js', 'views.js', 'space.js', 'live.js', 'main.js'
)  # fmt: skip


def page(
    title: str, headline: str, numbers: str, command: str, content: dict, arrays: Arrays, live: bool = False
) -> str:
    """A page that loads nothing and runs no script but its own, whose digest its policy names.

    Parameters
    ----------
    title, headline : str
        Plain text.
    numbers, command : str
        Markup of those sections, made by `table` and `code`.
    content : dict
        Data for the scripts (JSON); arrays: by name.
    live : bool
        Whether it asks the server that sent it for news.
    """
    content = content | dict(arrays={name: packed.head() for name, packed in arrays.items()})
    script = _script()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode('ascii')
    holders = (f'<script type="text/plain" id="array-{name}">{packed.text}</script>' for name, packed in arrays.items())
    return Template(_file('page.html')).substitute(
        digest=f'sha256-{digest}',
        connect="'self'" if live else "'none'",
        title=html.escape(title),
        headline=html.escape(headline),
        style='\n'.join(map(_file, STYLES)),
        numbers=numbers,
        command=command,
        known=as_json(content),
        arrays='\n'.join(holders),
        script=script,
    )


def as_json(value: object) -> str:
    """JSON that ends no element of a page: no `<`."""
    return json.dumps(value, allow_nan=False, separators=(',', ':')).replace('<', '\\u003c')


def html_table(title: str, rows: list[tuple[str, ...]], kind: str = '', head: tuple[str, ...] = ()) -> str:
    """A section with a table: of each row the name, the values, and what it means if `kind` is 'numbers'."""
    out = [f'<section><h2>{html.escape(title)}</h2><div class="scroll"><table class="{kind}">']
    if head:
        out.append('<thead><tr>' + ''.join(f'<th scope="col">{html.escape(h)}</th>' for h in head) + '</tr></thead>')
    for name, *cells in rows:
        classes = ['value'] * len(cells)
        if kind == 'numbers' and not head:
            classes[-1] = 'meaning'
        row_cells = ''.join(f'<td class="{c}">{html.escape(cell)}</td>' for c, cell in zip(classes, cells))
        out.append(f'<tr><th scope="row">{html.escape(name)}</th>{row_cells}</tr>')
    return ''.join([*out, '</table></div></section>'])


def picture(title: str, png: bytes, text: str) -> str:
    """A section with a still picture, and what it shows in words."""
    embedded = base64.b64encode(png).decode('ascii')
    return (
        f'<section><h2>{html.escape(title)}</h2><img class="still" alt="{html.escape(text)}" '
        f'src="data:image/png;base64,{embedded}"></section>'
    )


def code(title: str, text: str) -> str:
    """A section with a command, as it is."""
    return f'<section><h2>{html.escape(title)}</h2><pre>{html.escape(text)}</pre></section>'


def folded(title: str, parts: dict[str, list[tuple[str, str]]]) -> str:
    """A section of tables of names and values, each opened by a click."""
    out = [f'<section><h2>{html.escape(title)}</h2>']
    for name, rows in parts.items():
        cells = ''.join(f'<tr><th scope="row">{html.escape(a)}</th><td>{html.escape(b)}</td></tr>' for a, b in rows)
        out.append(f'<details><summary>{html.escape(name)}</summary><table>{cells}</table></details>')
    return ''.join([*out, '</section>'])


@cache
def _file(name: str) -> str:
    return files('lingo_mi.report').joinpath('web', *name.split('/')).read_text(encoding='utf-8')


@cache
def _script() -> str:
    libraries = '\n'.join(map(_file, LIBRARIES))
    scripts = '\n'.join(map(_file, SCRIPTS))
    return f"{libraries}\n(() => {{\n'use strict';\n{scripts}\n}})();\n"
