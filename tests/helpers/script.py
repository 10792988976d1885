"""Runs scripts, commands and studies for tests: in this process, where Mitsuba is loaded already, or in a new one."""

import contextlib
import io
import runpy
import subprocess
import sys
from pathlib import Path
from unittest import mock

import mitsuba as mi
import nibabel
import numpy as np

from lingo_mi.cli import run as run_command

FIT = Path(__file__).parents[2] / 'scripts' / 'fit.py'
RECONSTRUCT = FIT.with_name('reconstruct.py')

# A foot on 24^3 voxels before a panel of 32 x 40 pixels.
SCENE = """<scene version="3.0.0">
    <default name="views" value="8"/>
    <integrator type="lingo_xray"/>
    <shape type="cube" id="foot">
        <transform name="to_world"><scale value="12"/></transform>
        <medium type="ct_volume" name="interior">
            <string name="phantom" value="foot"/>
            <integer name="size" value="24"/>
            <transform name="to_world"><translate value="-0.5, -0.5, -0.5"/><scale value="24"/></transform>
        </medium>
        <bsdf type="null"/>
    </shape>
    <sensor type="ct_scanner" id="scanner">
        <float name="DSO" value="100"/>
        <float name="DSD" value="150"/>
        <string name="nDetector" value="32, 40"/>
        <string name="dDetector" value="1.8, 1.8"/>
        <string name="nVoxel" value="24, 24, 24"/>
        <string name="dVoxel" value="1, 1, 1"/>
        <integer name="views" value="$views"/>
        <integer name="test_views" value="3"/>
    </sensor>
</scene>
"""


def fit(*args, report=False):
    """Exit code, standard output and standard error of `fit.py ARGS`, run in this process.

    report   whether to draw the report too, which takes longer than such a fit
    """
    return run(FIT, *args, report=report)


def run(what, *args, report=False, variant=True):
    """Exit code, standard output and standard error of a command, run in this process; see `fit`.

    what      the path of a script, the name of a study (`studies.NAME`), or a command of `lingo-mi`
    variant   whether the command has a --variant, which is then the active one
    """
    out, err = io.StringIO(), io.StringIO()
    argv = [str(what), *map(str, args), *(['--variant', mi.variant()] if variant and '--variant' not in args else [])]
    drawn = contextlib.nullcontext() if report else mock.patch('lingo_mi.fitting.save.write_report')
    with drawn, mock.patch.object(sys, 'argv', argv), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            if isinstance(what, Path):
                runpy.run_path(str(what), run_name='__main__')
            elif what.startswith('studies.'):
                runpy.run_module(what, run_name='__main__')
            else:
                sys.argv[0] = f'lingo-mi {what}'
                run_command(what)
            code = 0
        except SystemExit as stop:
            code = stop.code
    return code, out.getvalue(), err.getvalue()


def fit_process(*args, **options):
    """`fit.py ARGS` as a process of its own, with both outputs piped."""
    return subprocess.Popen(
        [sys.executable, str(FIT), *map(str, args), '--variant', mi.variant()],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def changed_scene(folder, *pairs):
    """The tiny scene with some of its lines replaced."""
    text = SCENE
    for old, new in pairs:
        assert text.count(old) == 1
        text = text.replace(old, new)
    (folder / 'scene.xml').write_text(text)
    return folder / 'scene.xml'


def load(path):
    """The voxels of a NIfTI file."""
    return nibabel.load(path).get_fdata(dtype=np.float32)
