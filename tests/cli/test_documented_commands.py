"""The commands of the documentation and of the help texts: each is understood, and finds its options."""

import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from lingo_mi.cli import COMMANDS, main
from lingo_mi.cli.common import Parser, _settings

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / 'README.md', *(ROOT / 'docs').glob('*.md'), *(ROOT / 'docs').glob('[!_]*/**/*.md')])


class Understood(BaseException):
    """A command has read its arguments: no more is asked of it."""


def commands_in(text):
    """The command lines in a text, without comments and without what only a shell can fill in."""
    for line in text.replace('\\\n', ' ').splitlines():
        if line.strip().startswith('lingo-mi ') and '`' not in line:
            words = shlex.split(line, comments=True)
            if len(words) > 1 and words[1] in COMMANDS and words[2:] and words[2] != '...':
                yield [word for word in words if not re.fullmatch(r'\$[A-Z]+', word)]  # of several options


@pytest.fixture
def understood(monkeypatch, capsys):
    """Parse a command line and return its arguments; fail with what the command says of it."""
    parse = Parser.parse_known_args

    def stop(self, args=None, namespace=None):
        parse(self, args, namespace)
        raise Understood

    def check(words):
        monkeypatch.setattr(sys, 'argv', words)
        monkeypatch.setattr(Parser, 'parse_known_args', stop)
        try:
            main()
        except Understood:
            assert Parser.running is not None
            return Parser.running[1]
        except SystemExit:
            pass
        pytest.fail(f'{shlex.join(words)}: {capsys.readouterr().err}')

    return check


def check_all(text, understood):
    for words in commands_in(text):
        args = understood(words)
        settings = _settings(args) if getattr(args, 'define', None) else set()
        for name in (pair.partition('=')[0] for pair in getattr(args, 'define', None) or []):
            assert name in settings, f'{shlex.join(words)}: -D {name} is unknown'


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_of_the_documentation(page, understood):
    check_all(page.read_text(encoding='utf-8'), understood)


@pytest.mark.parametrize('name', COMMANDS)
def test_commands_of_the_help(name, monkeypatch, capsys, understood):
    monkeypatch.setattr(sys, 'argv', ['lingo-mi', name, '--help'])
    with pytest.raises(SystemExit):
        main()
    check_all(capsys.readouterr().out, understood)


def test_there_are_commands():
    assert sum(len(list(commands_in(page.read_text(encoding='utf-8')))) for page in PAGES) > 40


@pytest.mark.parametrize('source', ['docs/how_to/measured_data.md', 'lingo_mi/cli/import_frames.py'])
def test_the_first_import_of_the_documentation_runs(source, tmp_path, monkeypatch, capsys):
    """Its code runs unchanged, with folders and files of these names."""
    tifffile = pytest.importorskip('tifffile', reason='tifffile (the `formats` extra) is not installed')
    words = next(words for words in commands_in((ROOT / source).read_text(encoding='utf-8')) if words[1] == 'import')
    monkeypatch.chdir(tmp_path)
    for folder, count, level in (('frames', 6, 5000), ('flats', 2, 10000), ('darks', 2, 100)):
        (tmp_path / folder).mkdir()
        for i in range(count):
            tifffile.imwrite(tmp_path / folder / f'{i}.tif', np.full((8, 10), level + i, np.uint16))
    geometry = Path(words[words.index('--geometry') + 1])
    geometry.write_text('DSO: 100\nDSD: 150\ndDetector: 1\ntotalAngle: 360\n')
    monkeypatch.setattr(sys, 'argv', words)
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0, capsys.readouterr().err
    assert np.load('scan.npy').shape == (6, 8, 10) and Path('scan.yml').exists()
