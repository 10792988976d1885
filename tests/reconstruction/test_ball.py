"""A uniform ball by every algorithm: its density within .5 % about the centre, its place within .1 voxel.

`--slow -s` prints the table of docs/benchmarks/correctness.md: 360 views, and as many iterations as they need.
"""

import numpy as np
import pytest

from helpers.balls import BALL, assert_ball, ball_errors, ellipsoids, geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.reconstruction import ALGORITHMS
from lingo_mi.reconstruction.run import run_algorithm

# A panel off the axis by a few pixels, and one that reaches 110 mm on one side of the central ray, 10 mm on the other.
PANELS = {'(4, -7) mm': (72, (4.0, -7.0)), '(4, 50) mm': (40, (4.0, 50.0))}

SMALL = {
    'fdk': (360, {}),
    'sart': (40, dict(niter=3)),
    'os-sart': (60, dict(niter=4, blocksize=6)),
    'sirt': (40, dict(niter=30, lmbda=1.9, lmbda_red=1.0)),
    'cgls': (120, dict(niter=12)),
    'asd-pocs': (40, dict(niter=5)),
}
LARGE = {
    'fdk': {},
    'sart': dict(niter=5, lmbda_red=0.7),
    'os-sart': dict(niter=20),
    'sirt': dict(niter=50, lmbda=1.9, lmbda_red=1.0),
    'cgls': dict(niter=45),
    'asd-pocs': dict(niter=3),
}


@pytest.mark.parametrize(
    'name, mode',
    [
        pytest.param(name, mode, marks=pytest.mark.thorough if mode == 'cone' and name in ('sirt', 'cgls') else ())
        for name in SMALL
        for mode in ('cone', 'parallel')
    ],
)
def test_ball(name, mode):
    check(name, *SMALL[name], mode, '(4, -7) mm')


@pytest.mark.slow
@pytest.mark.parametrize('panel', PANELS)
@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('name', LARGE)
def test_ball_from_360_views(name, mode, panel):
    check(name, 360, LARGE[name], mode, panel)


def check(name, views, options, mode, panel):
    columns, offset = PANELS[panel]
    geo = geometry(mode, circular(views, start=3), nDetector=(64, columns), offDetector=offset)
    scan = ellipsoids(geo, BALL)
    volume = run_algorithm(scan, ALGORITHMS[name](**options)).volume
    assert volume.shape == geo.grid.shape and volume.dtype == np.float32
    density, place = ball_errors(volume, geo)
    settings = ', '.join(f'{name} = {value}' for name, value in options.items())
    print(f'\n| {name} | {settings} | {mode} | {panel} | {100 * density:+.2f} | {place:.3f} |')
    assert_ball(volume, geo)
