"""Volumes on voxels: filtered backprojection, iterative algorithms, and the refinement of a cloud's volume.

    found = lm.reconstruct(scan, lm.SART(niter=5))
    found.volume, found.residuals, found.seconds

An algorithm is an object with its options, which are checked when it is created. `lm.reconstruct` runs it. Code that has line
integrals and an active Mitsuba variant calls `run_algorithm`.
"""

from lingo_mi.reconstruction.algorithm import Algorithm, Reconstruction
from lingo_mi.reconstruction.asd_pocs import ASDPOCS
from lingo_mi.reconstruction.best import Best
from lingo_mi.reconstruction.cgls import CGLS
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.penalised import PenalisedLeastSquares
from lingo_mi.reconstruction.priors import (
    TGV,
    TV,
    Denoiser,
    DirectionalTV,
    Huber,
    NonLocalMeans,
    Prior,
    PriorSum,
    Wavelets,
)
from lingo_mi.reconstruction.refined import Refined
from lingo_mi.reconstruction.run import progress_bar, run_algorithm
from lingo_mi.reconstruction.sart import OSSART, SART, SIRT

ALGORITHMS: dict[str, type[Algorithm]] = {
    algorithm.name: algorithm
    for algorithm in (FDK, SART, OSSART, SIRT, CGLS, ASDPOCS, PenalisedLeastSquares, Refined, Best)
}

__all__ = [
    'ALGORITHMS',
    'ASDPOCS',
    'CGLS',
    'FDK',
    'OSSART',
    'SART',
    'SIRT',
    'TGV',
    'TV',
    'Algorithm',
    'Best',
    'Denoiser',
    'DirectionalTV',
    'Huber',
    'NonLocalMeans',
    'PenalisedLeastSquares',
    'Prior',
    'PriorSum',
    'Reconstruction',
    'Refined',
    'Wavelets',
    'progress_bar',
    'run_algorithm',
]
