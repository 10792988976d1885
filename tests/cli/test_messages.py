"""A library's message names Python's arguments; a command prints its options for them."""

import sys

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.cli import main
from lingo_mi.cli.common import Parser, guard, with_options
from lingo_mi.common.errors import InputError


def parser():
    p = Parser()
    p.add_argument('scene')
    p.add_argument('-D', dest='define', action='append', default=[])
    p.add_argument('--slab', type=int)
    p.add_argument('--mu-water', type=float)
    p.add_argument('--air', type=int, nargs=4)
    p.add_argument('--views', metavar='A:B:STEP')
    p.add_argument('--resume', action='store_true')
    return p


@pytest.mark.parametrize(
    ('message', 'printed'),
    [
        ('take slabs, such as slab=64', 'take slabs, such as --slab 64'),
        ('give mu_water=MU, or (resume=True)', 'give --mu-water MU, or (--resume)'),
        ('resume=True goes on; resume=False does not', '--resume goes on; resume=False does not'),
        ('give air=(v0, v1, u0, u1), a region', 'give --air v0 v1 u0 u1, a region'),
        ('drop them with views=(first, end, step)', 'drop them with --views A:B:STEP'),
        ("lambda_tv=0.1 and effects='ignore'", '-D lambda_tv=0.1 and -D effects=ignore'),
        ('set rate_pose=(2e-3, 2e-4), or lmbda=0.5', 'set -D rate_pose=2e-3,2e-4, or -D lmbda=0.5'),
        ('walnut.npy: name your file: projections=FILE', 'walnut.npy: name your file: -D projections=FILE'),
        ('-D effects=x: give --slab=3, or unheard=4', '-D effects=x: give --slab=3, or unheard=4'),
        ('out/slab=64/a.npy: write lm.Scan(views=3)', 'out/slab=64/a.npy: write lm.Scan(views=3)'),
        ('add <string name="slab" value="3"/>, name=\'\'', 'add <string name="slab" value="3"/>, name=\'\''),
    ],
)
def test_options_stand_for_arguments(message, printed, monkeypatch):
    monkeypatch.setattr(Parser, 'running', None)
    assert with_options(message) == message
    parser().parse_args(['walnut'])
    assert with_options(message) == printed


def test_a_command_prints_one_short_line(capsys):
    """The whole message stays in the library."""

    def fail():
        parser().parse_args(['none.xml'])
        raise InputError(f'{"x" * 1000}: give slab=64')

    with pytest.raises(SystemExit) as stop:
        guard(fail)
    err = capsys.readouterr().err
    assert stop.value.code == 2 and err.endswith(': give --slab 64\n') and len(err) < 310 and err.count('\n') == 1


def test_both_faces_of_an_import_without_flats(tmp_path, monkeypatch, capsys):
    np.save(tmp_path / 'raw.npy', np.full((4, 3, 5), 100, np.uint16))
    geometry = tmp_path / 'scan.yml'
    geometry.write_text('mode: parallel\ndDetector: 1\ntotalAngle: 180\n')
    with pytest.raises(
        InputError, match=r'give flats=FILE, .*: air=\(v0, v1, u0, u1\), .* percentile=P, or i0=COUNTS$'
    ):
        lm.load_raw(tmp_path / 'raw.npy', geometry)
    args = ['import', tmp_path / 'raw.npy', '--geometry', geometry, '--out', tmp_path / 'out.npy']
    monkeypatch.setattr(sys, 'argv', ['lingo-mi', *map(str, args)])
    with pytest.raises(SystemExit) as stop:
        main()
    err = capsys.readouterr().err
    assert stop.value.code == 2 and 'give --flats FILE, or the air level: --air v0 v1 u0 u1, a region' in err
    assert err.endswith('--air-percentile P, or --i0 COUNTS\n')
