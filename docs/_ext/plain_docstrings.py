"""Turns this project's plain docstrings into reStructuredText for autodoc.

What is plain in them, and what it becomes:

    name   what it is             a list of names and meanings, where two or more spaces or a line's end follow a name;
           and goes on            further lines are indented
        code = example()          a block of code, where a paragraph is indented and is no list of names, or is Python
    |A x - b|, rate_*             characters of reStructuredText, which lose their meaning outside of `backticks`

A docstring that holds directives or roles is reStructuredText already and stays as it is. Sections in
numpydoc's form may follow the plain text; `sphinx.ext.napoleon` reads them.
"""

import ast
import inspect
import re

from sphinx.ext.napoleon import Config, NumpyDocstring

NUMPYDOC = Config(napoleon_use_ivar=True, napoleon_use_rtype=False)
_NAME = r'`?[A-Za-z_|][\w.|/=\'-]*`?'
ENTRY = re.compile(rf'^({_NAME}(?:, {_NAME})*)(?:(?:\s{{2,}}|\s+:\s+)(\S.*))?$')
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
    """A paragraph, a list of names, or code."""
    indent = min(len(line) - len(line.lstrip()) for line in lines)
    bare = _widened([line[indent:] for line in lines])
    starts = [i for i, line in enumerate(bare) if _starts_entry(line, bare[i + 1 : i + 2])]
    if starts and all(i in starts or bare[i].startswith('  ') for i in range(starts[0], len(bare))):
        before = [escaped(' '.join(line.strip() for line in bare[: starts[0]])), ''] if starts[0] else []
        entries = [bare[i:j] for i, j in zip(starts, [*starts[1:], len(bare)])]
        return '\n'.join(before + [_entry(entry) for entry in entries])
    language = _language(bare)
    if indent or language != 'text':
        return f'.. code-block:: {language}\n\n' + '\n'.join(f'    {line}' for line in bare)
    if all(line.startswith('- ') or line.startswith('  ') for line in bare):
        return '\n'.join(escaped(line) for line in bare)
    head = next((i for i, line in enumerate(bare) if i and line.startswith('    ')), len(bare))
    text = escaped('\n'.join(line.strip() for line in bare[:head]))
    return text if head == len(bare) else f'{text}\n\n{_block(bare[head:])}'


def _widened(lines: list[str]) -> list[str]:
    """Two spaces behind a name that fills its column, too."""
    columns = {match.start(2) for line in lines if (match := ENTRY.match(line)) and match[2]}
    if len(columns) != 1:
        return lines
    column = columns.pop()
    return [
        f'{line[:column]} {line[column:]}'
        if re.fullmatch(f'{_NAME} ', line[:column]) and line[column:].strip()
        else line
        for line in lines
    ]


def _starts_entry(line: str, following: list[str]) -> bool:
    """Whether names stand at the start of a line, with their meaning behind them or indented below."""
    found = ENTRY.match(line)
    return bool(found and (found[2] or following and following[0].startswith('    ')))


def _entry(lines: list[str]) -> str:
    """One name, or several, and what is said of it."""
    names, first = ENTRY.match(lines[0]).groups()
    meaning = escaped(' '.join([first or '', *(line.strip() for line in lines[1:])]).strip())
    title = ', '.join(f'``{name.strip("`")}``' for name in names.split(', '))
    return f'{title}\n    {meaning}\n'


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
