"""An update of SART is traced once: scans of one size and threads share the recording, and a replayed update is the traced one to
the bit."""

from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import numpy as np
import pytest

from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.grid import project_volume
from lingo_mi.projectors.replay import Replay
from lingo_mi.reconstruction import OSSART, SART, sart_update
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan


def scan(voxels=(6, 5, 4), panel=(5, 7), views=4, start=0.0):
    angles = start + np.linspace(0, 2 * np.pi, views, endpoint=False)
    geometry = Geometry.cone(DSO=40, DSD=60, nDetector=panel, dDetector=2.0, nVoxel=voxels, dVoxel=1.5, angles=angles)
    return Scan(geometry, project_volume(np.random.default_rng(0).random(voxels), geometry))


@pytest.mark.parametrize('weighted', [False, True])
@pytest.mark.parametrize(
    'voxels, panel, views',
    [
        ((6, 5, 4), (5, 7), 5),
        ((1, 1, 1), (1, 1), 1),
        ((5, 5, 1), (1, 6), 3),
        ((1, 1, 8), (6, 1), 2),
        ((4, 4, 4), (8, 8), 1),
    ],
)
def test_a_replayed_update_is_the_traced_one(voxels, panel, views, weighted):
    measured = scan(voxels, panel, views)
    weights = np.random.default_rng(1).random(voxels) if weighted else None
    algorithm = OSSART(niter=3, blocksize=2, lmbda=0.7)
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        traced = run_algorithm(measured, algorithm, weights=weights)
    result = run_algorithm(measured, algorithm, weights=weights)
    assert result.residuals == traced.residuals and result.residuals[-1] < result.residuals[0]
    np.testing.assert_array_equal(result.volume, traced.volume)


def test_scans_of_one_size_share_a_recording(monkeypatch):
    replay = Replay(sart_update._replayed)
    monkeypatch.setattr(sart_update, '_REPLAY', replay)
    for start in (0.0, 0.1, 0.2):
        run_algorithm(scan(start=start), SART(niter=3))
    assert [recording.n_recordings for recording in replay.recordings.values()] == [1]


def test_threads_share_a_recording(monkeypatch):
    measured, algorithm = scan(), SART(niter=20)
    alone = run_algorithm(measured, algorithm).volume
    monkeypatch.setattr(sart_update, '_REPLAY', Replay(sart_update._replayed))
    with ThreadPoolExecutor(4) as pool:
        for result in pool.map(lambda s: run_algorithm(s, algorithm), [measured] * 8):
            np.testing.assert_array_equal(result.volume, alone)
