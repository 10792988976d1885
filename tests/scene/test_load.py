"""Loading a scene: Mitsuba's errors in one line."""

import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.scene.load import load_scene, plain


def test_a_driver_without_optix_is_one_helpful_line():
    error = RuntimeError(
        '[parser.cpp:1718] At "a.xml" (line 4, col 2): failed to instantiate scene plugin of type "scene": '
        'Could not initialize OptiX!'
    )
    assert '\n' not in plain(error) and 'OptiX' in plain(error) and 'variant=llvm_ad_mono' in plain(error)


def test_poses_with_a_slip_in_them(tmp_path):
    numbers = ' '.join(['1.0'] * 200 + ['1.o'])
    scene = f"""<scene version="3.0.0"><sensor type="ct_scanner">
        <string name="nDetector" value="4"/><string name="nVoxel" value="4"/><string name="dVoxel" value="1"/>
        <string name="poses" value="{numbers}"/></sensor></scene>"""
    (tmp_path / 'a.xml').write_text(scene)
    with pytest.raises(InputError, match="poses must be 12 numbers for every view, or a file; '1.o' is not a number"):
        load_scene(tmp_path / 'a.xml')
    (tmp_path / 'a.xml').write_text(scene.replace(numbers, 'x' * 300))
    with pytest.raises(InputError, match='xxx.*name your file: poses=FILE'):
        load_scene(tmp_path / 'a.xml')
