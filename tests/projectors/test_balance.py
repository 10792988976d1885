"""Teams of lanes that are narrower than the processor's vectors, as teams of 8 are with AVX-512, or wider."""

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import pytest

# In a process of its own: what this guards against, an integer division by zero in a lane whose team is done, ends it.
PROGRAM = """
import sys
from lingo_mi.runtime import use_variant
use_variant(sys.argv[1])
from lingo_mi.projectors import balance, mesh, splat, voxelize
for module in (balance, mesh, splat, voxelize):
    module.LANES = int(sys.argv[2])
from test_mesh import BOX, test_convex_bodies_at_every_pixel
from test_splat import test_exact as splat_exact
from test_voxelize import test_exact as voxelize_exact
voxelize_exact((13, 7, 9))
splat_exact('cone')
test_convex_bodies_at_every_pixel(BOX, 'cone')
"""


@pytest.mark.parametrize('lanes', [2, 32])
def test_teams_of_any_width(lanes):
    """2 lanes: a vector holds several teams, which do not end together. 32: a team is several vectors."""
    found = subprocess.run(
        [sys.executable, '-c', PROGRAM, mi.variant(), str(lanes)],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
    )
    assert found.returncode == 0, found.stderr
