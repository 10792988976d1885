"""RTK on scans of this package. Needs the extra `reference`; every function takes its module `itk`.

RTK rotates about y: its (x, y, z) is (y, z, x) here. Gantry angles are the same. ITK arrays have reversed indices.

    import itk
    volume = reconstruct('FDK', scan, itk)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Geometry
from lingo_mi.scan import Scan


def gantry(geometry: Geometry, itk: Any) -> Any:
    """RTK's geometry object.

    A circle is told in RTK's own numbers, so that a comparison also finds an error in this package's rays.

    Raises
    ------
    InputError
        For a parallel beam.
    """
    if geometry.mode != 'cone':
        raise InputError('RTK is compared with on cone beams only')
    out = itk.RTK.ThreeDCircularProjectionGeometry.New()
    if not isinstance(geometry, CircularGeometry):
        rays, place = geometry.rays(), [1, 2, 0]
        right, up = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (rays.u, -rays.v))
        for vectors in zip(rays.source, rays.centre(geometry.nDetector), right, up):
            source, centre, *axes = (x[place].tolist() for x in vectors)
            out.AddProjection(*map(itk.Point[itk.D, 3], (source, centre)), *map(itk.Vector[itk.D, 3], axes))
        return out
    for angle in np.degrees(geometry.angles):
        out.AddProjection(geometry.DSO, geometry.DSD, float(angle), geometry.offDetector[1], geometry.offDetector[0])
    return out


def require_every_pixel(scan: Scan, program: str) -> None:
    """Raises InputError for a scan with pixels that are not valid: the program would take them for air."""
    if scan.valid is not None:
        raise InputError(f'{program} is compared only on scans whose pixels are all valid')


def volume_image(volume: np.ndarray, geometry: Geometry, itk: Any) -> Any:
    """A volume [x, y, z] as an ITK image (y, z, x)."""
    image = itk.image_from_array(np.ascontiguousarray(volume.transpose(0, 2, 1), np.float32))
    order = [1, 2, 0]
    first = np.array(geometry.grid.centre) - (np.array(geometry.grid.size) - geometry.grid.spacing) / 2
    image.SetSpacing([geometry.grid.spacing[i] for i in order])
    image.SetOrigin([float(first[i]) for i in order])
    return image


def projection_image(projections: np.ndarray, geometry: Geometry, itk: Any) -> Any:
    """Projections [view, v, u] as an ITK stack; rows upwards."""
    image = itk.image_from_array(np.ascontiguousarray(projections[:, ::-1], np.float32))
    (dv, du), (nv, nu) = geometry.dDetector, geometry.nDetector
    image.SetSpacing([du, dv, 1.0])
    image.SetOrigin([-(nu - 1) / 2 * du, -(nv - 1) / 2 * dv, 0.0])
    return image


def array(image: Any, itk: Any) -> np.ndarray:
    """A volume image as [x, y, z]."""
    return itk.array_from_image(image).transpose(0, 2, 1)


def reconstruct(kind: str, scan: Scan, itk: Any, **settings: Any) -> np.ndarray:
    """Volume [x, y, z] of one of RTK's filters.

    Parameters
    ----------
    kind : str
        'FDK', 'SART' or 'ConjugateGradient'.
    settings
        Arguments of the filter's Set... methods, such as NumberOfIterations=1.
    """
    require_every_pixel(scan, 'RTK')
    image = itk.Image[itk.F, 3]
    geometry = scan.geometry
    cls = getattr(itk.RTK, kind + 'ConeBeamReconstructionFilter')
    reconstruction = cls[image].New() if kind != 'SART' else cls[image, image].New()
    inputs = [
        volume_image(np.zeros(geometry.grid.shape), geometry, itk),
        projection_image(scan.projections, geometry, itk),
    ]
    if kind == 'ConjugateGradient':
        inputs.append(projection_image(np.ones_like(scan.projections), geometry, itk))
    for i, x in enumerate(inputs):
        reconstruction.SetInput(i, x)
    reconstruction.SetGeometry(gantry(geometry, itk))
    for name, value in settings.items():
        getattr(reconstruction, 'Set' + name)(value)
    reconstruction.Update()
    return array(reconstruction.GetOutput(), itk).copy()


def total_variation(scan: Scan, itk: Any, beta: float, alpha: float = 0.1, niter: int = 20) -> np.ndarray:
    """Volume [x, y, z] by RTK's ADMM with total variation: the least of |A x - b|^2 + alpha TV(x).

    Parameters
    ----------
    beta : float
        Weight of the split gradient: the smaller, the faster it converges, until it diverges, from few views sooner.
    niter : int
        Outer iterations, with ten conjugate gradients each.
    """
    require_every_pixel(scan, 'RTK')
    geometry = scan.geometry
    solver = itk.RTK.ADMMTotalVariationConeBeamReconstructionFilter[itk.Image[itk.F, 3]].New()
    solver.SetInput(0, volume_image(np.zeros(geometry.grid.shape), geometry, itk))
    solver.SetInput(1, projection_image(scan.projections, geometry, itk))
    solver.SetGeometry(gantry(geometry, itk))
    solver.SetGatingWeights([1.0] * len(geometry))  # without a filter in between, it loses its projections (2.7)
    solver.SetAlpha(alpha)
    solver.SetBeta(beta)
    solver.SetAL_iterations(niter)
    solver.SetCG_iterations(10)
    solver.Update()
    return array(solver.GetOutput(), itk).copy()


def project(volume: np.ndarray, geometry: Geometry, itk: Any) -> np.ndarray:
    """Projections [view, v, u] of a volume [x, y, z] by RTK's Joseph projector."""
    zeros = np.zeros((len(geometry), *geometry.nDetector))
    image = _filter(
        'JosephForwardProjectionImageFilter',
        geometry,
        itk,
        projection_image(zeros, geometry, itk),
        volume_image(volume, geometry, itk),
    )
    return itk.array_from_image(image)[:, ::-1]


def backproject(scan: Scan, itk: Any) -> np.ndarray:
    """Volume [x, y, z] of a scan by the transpose of that projector."""
    geometry = scan.geometry
    volume_out = _filter(
        'JosephBackProjectionImageFilter',
        geometry,
        itk,
        volume_image(np.zeros(geometry.grid.shape), geometry, itk),
        projection_image(scan.projections, geometry, itk),
    )
    return array(volume_out, itk)


def _filter(name, geometry, itk: Any, *inputs):
    image = itk.Image[itk.F, 3]
    run = getattr(itk.RTK, name)[image, image].New()
    for i, x in enumerate(inputs):
        run.SetInput(i, x)
    run.SetGeometry(gantry(geometry, itk))
    run.Update()
    return run.GetOutput()
