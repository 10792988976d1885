"""From a scene to a scan."""

import warnings

import pytest

from lingo_mi.scene.load import load_scene
from lingo_mi.scene.shipped import scene_path
from lingo_mi.scene.simulate import take_scan

SMALL = dict(pixels='16', pixel_size='32', size='16', voxels='16', voxel_size='16', views='2', test_views='1')


def test_a_truth_on_other_voxels_is_missed_aloud():
    foot = scene_path('x3d_foot')
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert take_scan(load_scene(foot, SMALL)).volume is not None
    with pytest.warns(UserWarning, match='not compared with the true one, since the scanner has other voxels'):
        assert take_scan(load_scene(foot, SMALL | dict(voxels='8'))).volume is None
