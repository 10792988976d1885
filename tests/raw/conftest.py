"""Simulated frames, and the geometry that goes with them."""

import pytest
import yaml

from helpers.raw_frames import raw_frames


@pytest.fixture(scope='module')
def raw():
    return raw_frames()


@pytest.fixture
def scan_yml(tmp_path):
    values = dict(DSO=100, DSD=150, dDetector=[1, 1], nVoxel=[16, 16, 16], dVoxel=1, angles=list(range(0, 360, 60)))
    path = tmp_path / 'scan.yml'
    path.write_text(yaml.safe_dump(values))
    return path
