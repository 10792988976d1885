"""The command line: `lingo-mi COMMAND`, one module a command, and what they share (`common`)."""

from __future__ import annotations

import importlib
import sys
from typing import NamedTuple

from lingo_mi.cli.common import guard
from lingo_mi.common.parsing import nearest


class Command(NamedTuple):
    """A command of `lingo-mi`: its module here, what it does, and the arguments of an example."""

    module: str
    does: str
    example: str


# In the order of the help.
GROUPS = {
    'From a scan to a volume and new views': {
        'fit': Command(
            'fit', 'fit a cloud of 3D Gaussians to a scan; makes a volume and new views', 'x3d_foot --views 25'
        ),
        'reconstruct': Command(
            'reconstruct',
            'reconstruct a volume on voxels: FDK, SART, ASD-POCS and others',
            'scan.npy --algorithm asd-pocs',
        ),
        'batch': Command(
            'batch',
            'fit a cohort, a list of scans, here or on a cluster; makes a table of all results',
            'cohort.csv --out out/cohort',
        ),
        'compare': Command('compare', 'show results side by side in one page', 'out/fast out/lingo'),
    },
    'Scans': {
        'import': Command(
            'import_frames',
            "turn a scanner's raw frames into a scan",
            'tiffs/ --geometry scan.yml --flats flats/ --out scan.npy',
        ),
        'inspect': Command(
            'inspect_scan', 'look at a scan before work: air, noise, truncation, order of the views, axis', 'scan.npy'
        ),
        'calibrate': Command(
            'calibrate',
            'find where the panel really is: axis off centre, turn in its plane, drift',
            'scan.npy --out calibrated.npy',
        ),
        'phantom': Command('phantom', 'make a test object and a scan of it', 'foot --out foot.nii.gz'),
    },
    'Checks: derivatives, accuracy, speed, the numbers of the paper': {
        'gradcheck': Command('gradcheck', "check the derivatives of a scene's image against differences", 'gaussians'),
        'accuracy': Command('accuracy', 'measure what accuracy costs in time', '--quick'),
        'bench': Command(
            'bench', "time the integrator against a kernel written by hand and against Mitsuba's tree", '--no-bvh'
        ),
        'x3d': Command('x3d', "make the paper's Tables 1 to 3 from a folder of X3D's scans", 'x3d/'),
    },
}
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}

OPTIONS = """Options
  -h, --help                  this text; after a command, what it takes
  --version                   versions of all that matters: put them into a report of a bug
  --print-completion SHELL    a script that completes commands and options: bash, zsh, fish or tcsh
"""


def run(command: str) -> None:
    """Run one command with the arguments in `sys.argv`, and exit."""
    guard(lambda: importlib.import_module(f'lingo_mi.cli.{COMMANDS[command].module}').main())


def summary() -> str:
    """Return the text of `lingo-mi --help`: the commands in groups, each with an example."""
    width = max(map(len, COMMANDS))
    lines = ['usage: lingo-mi COMMAND ...   (lingo-mi COMMAND --help)', '']
    for title, commands in GROUPS.items():
        lines.append(title)
        for name, (_, does, example) in commands.items():
            lines += [f'  {name:{width}s}  {does}', f'  {"":{width}s}  $ lingo-mi {name} {example}']
        lines.append('')
    return '\n'.join(lines) + '\n' + OPTIONS


def main() -> None:
    """The console command `lingo-mi`."""
    wanted, *more = sys.argv[1:] or ['--help']
    if wanted in ('-h', '--help'):
        print(summary(), end='')
    elif wanted == '--version':
        from lingo_mi.cli.version import report

        print(report())
    elif wanted == '--print-completion':
        from lingo_mi.cli.completion import print_script

        guard(lambda: print_script(more))
    elif wanted in COMMANDS:
        sys.argv[:2] = [f'lingo-mi {wanted}']
        run(wanted)
    else:
        near = nearest(wanted, COMMANDS)
        print(f'error: there is no command {wanted!r}{near}; use one of {", ".join(COMMANDS)}', file=sys.stderr)
        sys.exit(2)
