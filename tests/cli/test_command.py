"""The console command `lingo-mi`: its help, its commands, the scripts that are the same, and the studies."""

import importlib
import platform
import re
import runpy
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from lingo_mi import phantoms
from lingo_mi.cli import COMMANDS, main
from lingo_mi.cli.common import Help

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / 'scripts'
STUDIES = sorted(
    {path.stem for path in ROOT.glob('studies/*.py') if 'run_study(' in path.read_text() and path.stem != 'command'}
    | {path.parent.name for path in ROOT.glob('studies/*/__main__.py')}
)


@pytest.fixture
def command(monkeypatch, capsys):
    """Exit code (0 if it returns), standard output and standard error of `lingo-mi ARGS`, in this process."""

    def call(*args):
        monkeypatch.setattr(sys, 'argv', ['lingo-mi', *map(str, args)])
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return call


@pytest.mark.parametrize('args', [(), ('-h',), ('--help',)])
def test_help_lists_the_commands(command, args):
    code, out, err = command(*args)
    assert code == 0 and not err and out.startswith('usage: lingo-mi COMMAND')
    lines = [line.split() for line in out.splitlines() if line.startswith('  ')]
    assert [words[0] for words in lines if words[0] in COMMANDS] == list(COMMANDS) and len(COMMANDS) <= 12
    assert [words[2] for words in lines if words[:2] == ['$', 'lingo-mi']] == list(COMMANDS)


@pytest.mark.parametrize('name', COMMANDS)
def test_an_example_of_the_help_parses(name):
    command = COMMANDS[name]
    importlib.import_module(f'lingo_mi.cli.{command.module}').parser().parse_args(command.example.split())


def test_version(command):
    code, out, err = command('--version')
    versions = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert code == 0 and not err and versions['lingo_mi'] == version('lingo_mi')
    assert versions['numpy'] == np.__version__ and versions['Python'] == platform.python_version()
    assert 'llvm_ad_mono' in versions['variants'] and versions['LLVM'].split('.')[0].isdigit()


def test_completion(command):
    shtab = pytest.importorskip('shtab')
    for shell in shtab.SUPPORTED_SHELLS:
        code, out, err = command('--print-completion', shell)
        assert code == 0 and not err and 'reconstruct' in out and 'asd-pocs' in out, shell
    for wrong in ((), ('ksh',)):
        code, out, err = command('--print-completion', *wrong)
        assert code == 2 and not out and 'bash' in err and err.count('\n') == 1


def test_completion_without_its_package(command, monkeypatch):
    monkeypatch.setitem(sys.modules, 'shtab', None)
    code, out, err = command('--print-completion', 'bash')
    assert code == 2 and not out and 'pip install' in err and err.count('\n') == 1


@pytest.mark.parametrize('wanted', ['fits', '--verbose', ''])
def test_unknown_command(command, wanted):
    code, out, err = command(wanted)
    assert code == 2 and not out and err.startswith(f'error: there is no command {wanted!r}') and err.count('\n') == 1
    assert all(name in err for name in COMMANDS)
    assert ('did you mean fit?' in err) == (wanted == 'fits')


def test_phantom_list(command):
    code, out, _ = command('phantom', '--list')
    assert code == 0 and [line.split()[0] for line in out.splitlines()] == list(phantoms.names())


@pytest.mark.parametrize('name', COMMANDS)
def test_every_command_describes_itself(command, name):
    code, out, err = command(name, '--help')
    assert code == 0 and out.startswith(f'usage: lingo-mi {name} ') and not err


@pytest.mark.parametrize('name', COMMANDS)
def test_help_fits_a_terminal(command, monkeypatch, name):
    """Commands may be longer, so that they can be copied, and the choices of an option, which argparse does not break."""
    monkeypatch.setenv('COLUMNS', '80')
    lines = command(name, '--help')[1].splitlines()
    assert not [line for line in lines if len(line) > 80 and not re.search('^ *lingo-mi |{.*}', line)]


def test_help_keeps_lists_and_commands():
    text = 'a text\nof two lines\n\n    one    explains,\n           and goes on\n    two    it\n\n    lingo-mi fit long_name'
    assert Help('lingo-mi')._fill_text(text, 24, '').split('\n') == [
        'a text of two lines',
        '',
        '    one    explains, and',
        '           goes on',
        '    two    it',
        '',
        '    lingo-mi fit long_name',
    ]


@pytest.mark.parametrize('path', sorted(SCRIPTS.glob('*.py')), ids=lambda path: path.stem)
def test_a_script_is_a_command(monkeypatch, capsys, path):
    monkeypatch.setattr(sys, 'argv', [str(path), '--help'])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(path), run_name='__main__')
    name = path.name if path.stem in COMMANDS else f'python -m studies.{path.stem}'
    assert stop.value.code == 0 and capsys.readouterr().out.startswith(f'usage: {name} ')


@pytest.mark.parametrize('name', STUDIES)
def test_every_study_describes_itself(monkeypatch, capsys, name):
    for args, expected in ((['--help'], 0), (['--no-such-option'], 2)):
        monkeypatch.setattr(sys, 'argv', [name, *args])
        program = f'studies.{name}' if (ROOT / 'studies' / f'{name}.py').exists() else f'studies.{name}.__main__'
        monkeypatch.delitem(sys.modules, program, raising=False)  # runpy would warn of it
        with pytest.raises(SystemExit) as stop:
            runpy.run_module(f'studies.{name}', run_name='__main__')
        out, err = capsys.readouterr()
        assert stop.value.code == expected and out.startswith(f'usage: python -m studies.{name} ') == (expected == 0)
        assert not err if expected == 0 else err.startswith('error: ') and err.count('\n') == 1


@pytest.mark.parametrize('name', COMMANDS)
def test_a_bad_option_is_one_line(command, name):
    code, out, err = command(name, '--no-such-option')
    assert code == 2 and not out and err.startswith('error: ') and err.count('\n') == 1


def test_as_a_module():
    def run(*args):
        return subprocess.run([sys.executable, '-m', 'lingo_mi', *args], capture_output=True, text=True)

    done = run('phantom', '--list')
    assert done.returncode == 0 and 'shepp_logan' in done.stdout
    done = run('nothing')
    assert done.returncode == 2 and done.stderr.startswith('error: ') and done.stderr.count('\n') == 1


def test_an_unknown_phantom_is_said_before_a_missing_out(command):
    code, out, err = command('phantom', 'hand')
    assert code == 2 and not out and err.startswith("error: there is no phantom 'hand'") and err.count('\n') == 1
