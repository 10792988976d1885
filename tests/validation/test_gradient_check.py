"""The gradient check: it passes where derivatives are right, fails where they are not, refuses what it cannot check."""

import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.same import assert_same
from helpers.script import run
from lingo_mi.common.errors import InputError
from lingo_mi.files.ply import write_ply
from lingo_mi.validation import gradient_check
from lingo_mi.validation.gradient_check import check_gradients, gradient_table, load_scene_file
from lingo_mi.validation.oracle import random_cloud

SCRIPT = Path(__file__).parents[2] / 'scripts' / 'gradcheck.py'
XML = """<scene version="3.0.0">
    <integrator type="lingo_xray"><string name="output" value="{output}"/></integrator>
    {sensor}
    <shape type="ellipsoids" id="cloud"><string name="filename" value="cloud.ply"/></shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value=".5"/></transform> <bsdf type="null"/>
        <medium name="interior" type="heterogeneous">
            <float name="albedo" value="0"/>
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="grid.vol"/> <boolean name="raw" value="true"/>
                <transform name="to_world"><translate x="-.5" y="-.5" z="-.5"/></transform>
            </volume>
        </medium>
    </shape>
</scene>"""
SENSORS = {
    'scanner': """<sensor type="ct_scanner"> <float name="DSO" value="5"/> <float name="DSD" value="7"/>
        <string name="nDetector" value="17, 22"/> <string name="dDetector" value=".2"/>
        <string name="nVoxel" value="8"/>
        <string name="dVoxel" value=".25"/> <string name="angles" value="20"/></sensor>""",
    'camera': """<sensor type="perspective"> <float name="fov" value="35"/>
        <transform name="to_world"><lookat origin="3, 1, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="20"/><integer name="height" value="15"/></film></sensor>""",
    'parallel': """<sensor type="orthographic">
        <transform name="to_world"><lookat origin="3, 1, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="20"/><integer name="height" value="15"/></film></sensor>""",
}


def scene_file(folder, sensor='scanner', output='line_integral'):
    rng = np.random.default_rng(0)
    cloud = random_cloud(rng, 5, size=0.15)
    write_ply(folder / 'cloud.ply', cloud.centre, cloud.scale, cloud.rotation, cloud.density)
    mi.VolumeGrid(np.float32(rng.random((3, 4, 5, 1)))).write(str(folder / 'grid.vol'))
    path = folder / 'scene.xml'
    path.write_text(XML.format(sensor=SENSORS[sensor], output=output))
    return path


def script(*arguments):
    return subprocess.run(
        [sys.executable, SCRIPT, *map(str, arguments)], capture_output=True, text=True, env=os.environ, timeout=300
    )


@pytest.mark.parametrize('sensor', SENSORS)
@pytest.mark.parametrize('output', ['line_integral', 'transmission'])
def test_right_derivatives_pass(tmp_path, sensor, output):
    scene = load_scene_file(scene_file(tmp_path, sensor, output))
    before = np.array(mi.render(scene))
    rows = check_gradients(scene, count=3)
    assert len(rows) == 3 * (3 + 3 + 4 + 1) + 3
    assert max(row.error for row in rows) < 1e-5
    assert all(row.ad != 0 for row in rows)
    lines = gradient_table(rows).splitlines()
    assert len(lines) == len(rows) + 1
    assert 'cloud.centre[' in lines[1] and 'box.interior_medium.sigma_t.data[' in lines[-1]
    assert_same(mi.render(scene), before)  # the scene is given back as it was


@pytest.mark.parametrize('part, kind', [('data', 'scale'), ('density', 'density')])
def test_wrong_derivatives_are_found(tmp_path, monkeypatch, part, kind):
    """A cloud whose gradient is off by a thousandth in one place."""
    honest = dr.grad

    def wrong(value, *args, **kwargs):
        gradient = honest(value, *args, **kwargs)
        size = {'data': 50, 'density': 5}[part]
        return gradient * 1.001 if isinstance(gradient, mi.Float) and dr.width(gradient) == size else gradient

    monkeypatch.setattr(dr, 'grad', wrong)
    rows = check_gradients(load_scene_file(scene_file(tmp_path)), count=2)
    assert max(row.error for row in rows if kind in row.parameter) > gradient_check.TOLERANCE
    assert max(row.error for row in rows if 'box' in row.parameter) < 1e-5


def test_script(tmp_path, variant):
    done = script(scene_file(tmp_path), '-n', 1, '--variant', variant)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].split() == ['parameter', 'AD', 'differences', 'error'] and len(lines) == 1 + 11 + 1 + 1


def test_script_refuses_bad_input(tmp_path):
    broken = tmp_path / 'broken.xml'
    broken.write_text('<scene version="3.0.0"><shape type="nothing_known"/></scene>')
    for arguments in ((tmp_path / 'absent.xml',), (broken,), (scene_file(tmp_path), '-n', 0), (broken, '--step', 'x')):
        code, out, err = run(SCRIPT, *arguments)
        assert code == 2 and out == ''
        assert err.startswith('error: ') and len(err.strip().splitlines()) == 1


def test_refusals(tmp_path):
    scene = load_scene_file(scene_file(tmp_path))
    for values in (dict(count=0), dict(step=0.0), dict(step=1.0), dict(step=float('nan'))):
        with pytest.raises(InputError, match='count must be at least 1'):
            check_gradients(scene, **values)
    with pytest.raises(InputError, match='lingo_xray'):
        check_gradients(mi.load_dict(dict(type='scene', integrator=dict(type='path'))))
    sensor = dict(type='ct_scanner', DSO=5, DSD=7, nDetector='4', dDetector='1', nVoxel='4', dVoxel='1')
    mesh = dict(type='cube', bsdf=dict(type='null'), interior=dict(type='homogeneous', sigma_t=1.0))
    with pytest.raises(InputError, match='no derivative to check'):
        check_gradients(mi.load_dict(dict(type='scene', integrator=dict(type='lingo_xray'), sensor=sensor, mesh=mesh)))
    with pytest.raises(InputError, match='nothing that attenuates'):
        check_gradients(mi.load_dict(dict(type='scene', integrator=dict(type='lingo_xray'), sensor=sensor)))
