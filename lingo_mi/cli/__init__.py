"""The command line: `lingo-mi COMMAND`, one module a command, and what they share (`common`)."""

from __future__ import annotations

import importlib
import sys
from importlib.metadata import version

from lingo_mi.cli.common import guard
from lingo_mi.common.parsing import nearest

# In the order of the help: command -> what it does.
COMMANDS = {
    'fit': 'fit a cloud of 3D Gaussians to a scan; makes a volume and new views',
    'batch': 'fit a cohort, a list of scans, here or on a cluster; makes a table of all results',
    'reconstruct': 'reconstruct a volume on voxels: FDK, SART, ASD-POCS and others',
    'compare': 'show results side by side in one page',
    'import': "turn a scanner's raw frames into a scan",
    'inspect': 'look at a scan before work: air, noise, truncation, order of the views, axis',
    'calibrate': 'find where the panel really is: axis off centre, turn in its plane, drift',
    'phantom': 'make a test object and a scan of it',
    'gradcheck': "check the derivatives of a scene's image against differences",
    'accuracy': 'measure what accuracy costs in time',
    'bench': "time the integrator against a kernel written by hand and against Mitsuba's tree",
    'x3d': "make the paper's tables from a folder of X3D's scans",
}

MODULES = {'import': 'import_frames', 'inspect': 'inspect_scan'}  # names that Python has a use for


def run(command: str) -> None:
    """Run one command with the arguments in `sys.argv`, and exit."""
    name = MODULES.get(command, command.replace('-', '_'))
    guard(lambda: importlib.import_module(f'lingo_mi.cli.{name}').main())


def main() -> None:
    """The console command `lingo-mi`."""
    wanted = sys.argv[1] if len(sys.argv) > 1 else '--help'
    if wanted in ('-h', '--help'):
        width = max(map(len, COMMANDS))
        print('usage: lingo-mi COMMAND ...   (lingo-mi COMMAND --help)\n')
        print('\n'.join(f'  {name:{width}s}  {what}' for name, what in COMMANDS.items()))
        return
    if wanted == '--version':
        print(f'lingo_mi {version("lingo_mi")}')
        return
    if wanted not in COMMANDS:
        near = nearest(wanted, COMMANDS)
        print(f'error: there is no command {wanted!r}{near}; use one of {", ".join(COMMANDS)}', file=sys.stderr)
        sys.exit(2)
    sys.argv[:2] = [f'lingo-mi {wanted}']
    run(wanted)
