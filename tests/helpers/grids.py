"""What tests share with grid projector."""

from lingo_mi.geometry.base import CircularGeometry
from lingo_mi.geometry.trajectories import circular


def scan(mode='cone', n=4, **changes):
    settings = dict(
        DSO=200.0,
        DSD=300.0,
        nDetector=(17, 21),
        dDetector=(3.0, 2.6),
        nVoxel=(9, 11, 7),
        dVoxel=(4.0, 3.0, 5.0),
        angles=circular(n, start=11),
        mode=mode,
        offOrigin=(3.0, -2.0, 1.0),
        offDetector=(2.0, -4.0),
    )
    return CircularGeometry(**{**settings, **changes})
