"""Volumes on voxels: filtered backprojection, iterative algorithms, and the refinement of a cloud's volume.

    from lingo_mi.reconstruction import SART, reconstruct
    found = reconstruct(scan, SART(niter=5))
    found.volume, found.residuals, found.seconds

An algorithm is an object with its options, which are checked when it is created. Its `run` reconstructs a scan and returns a
`Reconstruction`. `reconstruct` does the same, after it has checked that rays meet the volume and that there is enough memory.
A Mitsuba variant must be active.
"""

from lingo_mi.reconstruction.algorithm import Algorithm, Reconstruction
from lingo_mi.reconstruction.asd_pocs import ASDPOCS
from lingo_mi.reconstruction.best import Best
from lingo_mi.reconstruction.cgls import CGLS
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.refined import Refined
from lingo_mi.reconstruction.run import check_scan, progress_bar, reconstruct
from lingo_mi.reconstruction.sart import OSSART, SART, SIRT

ALGORITHMS: dict[str, type[Algorithm]] = {
    algorithm.name: algorithm for algorithm in (FDK, SART, OSSART, SIRT, CGLS, ASDPOCS, Refined, Best)
}

__all__ = [
    'ALGORITHMS',
    'ASDPOCS',
    'CGLS',
    'FDK',
    'OSSART',
    'SART',
    'SIRT',
    'Algorithm',
    'Best',
    'Reconstruction',
    'Refined',
    'check_scan',
    'progress_bar',
    'reconstruct',
]
