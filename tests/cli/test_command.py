"""The console command `lingo-mi`: its help, its commands, and the scripts that are the same."""

import runpy
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from lingo_mi import phantoms
from lingo_mi.cli import COMMANDS, MODULES, main

SCRIPTS = Path(__file__).parents[2] / 'scripts'


@pytest.fixture
def command(monkeypatch, capsys):
    """Exit code (0 where it returns), standard output and standard error of `lingo-mi ARGS`, in this process."""

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
    listed = [line.split()[0] for line in out.splitlines() if line.startswith('  ')]
    assert listed == list(COMMANDS)


def test_version(command):
    assert command('--version') == (0, f'lingo_mi {version("lingo_mi")}\n', '')


@pytest.mark.parametrize('wanted', ['fits', '--verbose', ''])
def test_unknown_command(command, wanted):
    code, out, err = command(wanted)
    assert code == 2 and not out and err.startswith(f'error: there is no command {wanted!r}') and err.count('\n') == 1
    assert all(name in err for name in COMMANDS)


def test_phantom_list(command):
    code, out, _ = command('phantom', '--list')
    assert code == 0 and [line.split()[0] for line in out.splitlines()] == list(phantoms.names())


@pytest.mark.parametrize('name', COMMANDS)
def test_every_command_describes_itself(command, name):
    code, out, err = command(name, '--help')
    assert code == 0 and out.startswith(f'usage: lingo-mi {name} ') and not err


@pytest.mark.parametrize('name', COMMANDS)
def test_every_command_is_a_script(monkeypatch, capsys, name):
    path = SCRIPTS / f'{MODULES.get(name, name.replace("-", "_"))}.py'
    monkeypatch.setattr(sys, 'argv', [str(path), '--help'])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(path), run_name='__main__')
    assert stop.value.code == 0 and capsys.readouterr().out.startswith(f'usage: {path.name} ')


def test_there_are_no_other_scripts():
    assert {path.stem for path in SCRIPTS.glob('*.py')} == {MODULES.get(c, c.replace('-', '_')) for c in COMMANDS}


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
