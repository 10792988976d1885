"""Scenes from files, whichever package is imported first."""

import os
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

from helpers.scenes import block, cloud_of, ellipsoids, grid, load, render, values_of
from lingo_mi.files.ply import write_ply
from lingo_mi.validation.oracle import relative

XML = """<scene version="3.0.0">
    <integrator type="lingo_xray"><float name="extent" value="6"/></integrator>
    <sensor type="ct_scanner">
        <float name="DSO" value="5"/> <float name="DSD" value="7.5"/>
        <string name="nDetector" value="23, 30"/> <string name="dDetector" value=".14, .11"/>
        <string name="offDetector" value=".1, -.2"/> <string name="angles" value="33"/>
        <string name="nVoxel" value="8"/> <string name="dVoxel" value=".25"/>
    </sensor>
    <shape type="ellipsoids"><string name="filename" value="cloud.ply"/></shape>
    <shape type="cube">
        <transform name="to_world"><scale x=".4" y=".5" z=".6"/><translate x=".1" y=".2" z=".3"/></transform>
        <bsdf type="null"/>
        <medium name="interior" type="heterogeneous">
            <float name="albedo" value="0"/>
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="grid.vol"/> <boolean name="raw" value="true"/>
                <transform name="to_world">
                    <translate x="-.5" y="-.5" z="-.5"/><scale value="2"/>
                    <scale x=".4" y=".5" z=".6"/><translate x=".1" y=".2" z=".3"/>
                </transform>
            </volume>
        </medium>
    </shape>
    <shape type="cube">
        <transform name="to_world">
            <scale x=".2" y=".3" z=".25"/><rotate x="1" y="2" z="3" angle="40"/><translate x="-.3" y="-.2" z=".1"/>
        </transform>
        <bsdf type="null"/>
        <medium name="interior" type="homogeneous">
            <float name="sigma_t" value="1.3"/> <float name="albedo" value="0"/>
        </medium>
    </shape>
</scene>"""


@pytest.fixture
def scene_file(tmp_path):
    cloud = cloud_of()
    write_ply(tmp_path / 'cloud.ply', cloud.centre, cloud.scale, cloud.rotation, cloud.density)
    mi.VolumeGrid(np.float32(values_of().transpose(2, 1, 0))[..., None]).write(str(tmp_path / 'grid.vol'))
    path = tmp_path / 'scene.xml'
    path.write_text(XML)
    return path


def test_scene_file(scene_file):
    expected = render(load(dict(cloud=ellipsoids(cloud_of()), grid=grid(values_of()), block=block())))
    assert relative(render(mi.load_file(str(scene_file))), expected) < 2e-6


ORDERS = (
    'import lingo_mi, mitsuba as mi; mi.set_variant("{}")',
    'import mitsuba as mi; mi.set_variant("{}"); import lingo_mi',
    'import mitsuba as mi; mi.set_variant("scalar_rgb"); import lingo_mi; mi.set_variant("{}")',
)


@pytest.mark.parametrize(
    'order, kind',
    [
        pytest.param(order, kind, marks=() if (order, kind) == (ORDERS[2], 'rgb') else pytest.mark.thorough)
        for order in ORDERS
        for kind in ('mono', 'rgb')
    ],
)
def test_either_import_order(order, kind, scene_file, variant):
    name = variant.rsplit('_', 1)[0] + '_' + kind
    code = f'{order.format(name)}\nimport numpy\nprint(numpy.array(mi.render(mi.load_file({str(scene_file)!r}))).sum())'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, env=os.environ, timeout=120)
    assert done.returncode == 0, done.stderr
    assert abs(float(done.stdout) / render(mi.load_file(str(scene_file))).sum() - 1) < 1e-6
