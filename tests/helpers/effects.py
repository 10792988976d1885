"""Helpers of tests of rendered effects."""

from importlib.util import find_spec

import drjit as dr
import mitsuba as mi
import pytest

from lingo_mi.projectors.objects import find_objects
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.sensors import view_of

physics = pytest.mark.skipif(
    any(find_spec(m) is None for m in ('spekpy', 'xraylib')), reason="needs pip install '.[physics]'"
)


def kernels(function):
    """The hashes of the kernels that a function launches, once compiled."""
    function()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        function()
        return [k['hash'] for k in dr.kernel_history([dr.KernelType.JIT])]


def direct(scene, extent=6.0):
    """The image by the projectors alone: no code of the integrator's or of an effect's."""
    view = view_of(scene.sensors()[0])
    total = dr.zeros(mi.Float, view.height * view.width)
    for obj in find_objects(scene):
        total += obj.line_integrals(view, RenderOptions(extent))
    dr.eval(mi.TensorXf(total, shape=(view.height, view.width, 1)))


XML = """<scene version="3.0.0">
    <integrator type="lingo_xray"/>
    <shape type="cube" id="foot">
        <transform name="to_world"><scale value="12"/></transform>
        <medium type="ct_volume" name="interior">
            <string name="phantom" value="foot"/> <integer name="size" value="24"/> <float name="scale" value="0.2"/>
            <transform name="to_world"><translate value="-0.5, -0.5, -0.5"/><scale value="24"/></transform>
        </medium>
        <bsdf type="null"/>
    </shape>
    <sensor type="ct_scanner" id="scanner">
        <float name="DSO" value="100"/> <float name="DSD" value="150"/>
        <string name="nDetector" value="12, 16"/> <string name="dDetector" value="3.6"/>
        <string name="nVoxel" value="24"/> <string name="dVoxel" value="1"/>
        <integer name="views" value="6"/> <integer name="test_views" value="2"/>
        <film type="ct_detector"><float name="photons" value="1e4"/></film>
    </sensor>
    <emitter type="xray_tube" id="tube">
        <float name="kvp" value="120"/> <string name="material" value="soft tissue"/>
    </emitter>
</scene>"""
