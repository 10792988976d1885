"""Prepares numpydoc docstrings for `sphinx.ext.napoleon`.

Characters of reStructuredText, as in |A x - b| or rate_*, lose their meaning outside of `backticks`. An indented paragraph is a
block of code. A docstring that holds directives or roles is reStructuredText already and stays as it is.
"""

import ast
import inspect
import re

from sphinx.ext.napoleon import Config, NumpyDocstring

NUMPYDOC = Config(napoleon_use_ivar=True, napoleon_use_rtype=False)
RST = re.compile(r'^\s*\.\. |:\w+:`|^:param|^:return', re.MULTILINE)
SECTION = re.compile(r'^(?=[A-Z][\w ]*\n-{3,}$)', re.MULTILINE)  # before a title that is underlined
QUOTED = re.compile(r'(``.+?``|`[^`\n]+`)')


def to_rst(text: str) -> str:
    """reStructuredText of a plain docstring, indentation removed."""
    text = inspect.cleandoc(text)
    if RST.search(text):
        return text
    text, *sections = SECTION.split(text)
    sections = [section if section.startswith('Examples') else escaped(section) for section in sections]
    blocks = [block for block in re.split(r'\n\s*\n', text) if block.strip()]
    text = '\n\n'.join([*(_block(block.splitlines()) for block in blocks), *sections]) + '\n'
    return str(NumpyDocstring(text, NUMPYDOC)) if sections else text


def _block(lines: list[str]) -> str:
    """A paragraph, a list, or code."""
    indent = min(len(line) - len(line.lstrip()) for line in lines)
    if indent:
        bare = [line[indent:] for line in lines]
        return f'.. code-block:: {_language(bare)}\n\n' + '\n'.join(f'    {line}' for line in bare)
    return escaped('\n'.join(lines))


def _language(lines: list[str]) -> str:
    """What lines of code are in: 'pycon', 'python', or 'text', which may be words."""
    if lines[0].startswith('>>> '):
        return 'pycon'
    try:
        body = ast.parse('\n'.join(lines)).body
    except SyntaxError:
        return 'text'
    code = (ast.Assign, ast.Import, ast.ImportFrom, ast.For, ast.With)
    calls = (ast.Call, ast.Subscript)
    return (
        'python' if any(isinstance(x, code) or isinstance(getattr(x, 'value', None), calls) for x in body) else 'text'
    )


def escaped(text: str) -> str:
    """Text in which only `backticks` mark anything up; letters may follow them, as in `Scan`s."""
    parts = QUOTED.split(text)
    plain = [re.sub(r'([*|\\])|_(?=\W|$)', _escape, part) for part in parts[::2]]
    plain[1:] = [f'\\ {part}' if re.match(r'\w', part) else part for part in plain[1:]]
    parts[::2] = plain
    return ''.join(parts)


def _escape(match) -> str:
    return '\\' + match.group(0)


def process(app, what, name, thing, options, lines):
    lines[:] = [*to_rst('\n'.join(lines)).splitlines(), '']


def process_signature(app, what, name, obj, options, signature, returned):
    """Sphinx's stand-in for an alias of `autodoc_type_aliases`, which it leaves in unions, becomes the alias's name."""
    return tuple(text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r'\1', text) for text in (signature, returned))


def setup(app):
    app.connect('autodoc-process-signature', process_signature)
    app.connect('autodoc-process-docstring', process)
    return {'parallel_read_safe': True}
