"""Denoisers that replace a proximal map (plug and play)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError
from lingo_mi.projectors.upload import uploaded
from lingo_mi.reconstruction.parameters import check_counts
from lingo_mi.reconstruction.priors.prior import Prior, clipped


@dataclass
class Denoiser(Prior):
    """A denoiser that replaces a proximal map (plug and play).

    Parameters
    ----------
    function : callable
        It is called as function(volume, strength) with float32 [x, y, z], densities per mm, and a number in 1/mm that sets how
        much to smooth. It returns an array of the same shape.

    Raises
    ------
    InputError
        If the function cannot be called. In a reconstruction, if it fails or returns another shape, NaN or infinity.

    References
    ----------
    Venkatakrishnan, Bouman and Wohlberg, "Plug-and-play priors for model based reconstruction", GlobalSIP 2013.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> Denoiser(lambda volume, strength: gaussian_filter(volume, 0.5)).function(np.ones((2, 2, 2)), 0.1).shape
    (2, 2, 2)
    """

    function: Callable[[np.ndarray, float], Any]
    volumes: ClassVar[float] = 4.0  # the function may take more

    def __post_init__(self):
        if not callable(self.function):
            raise InputError(
                f'a denoiser is called as function(volume, strength), but {self.function!r} cannot be called'
            )

    def prox(self, x, strength, size, upper=inf):
        try:
            denoised = self.function(x.numpy().reshape(size).copy(), strength)  # which may work in place
        except Exception as error:
            raise InputError(f'the denoiser fails: {type(error).__name__}: {error}'.splitlines()[0]) from error
        volume = as_numpy(denoised, 'what the denoiser returns', np.float32)
        if volume.shape != tuple(size):
            raise InputError(f'the denoiser returns the shape {volume.shape} for a volume of the shape {tuple(size)}')
        if not np.isfinite(volume).all():
            raise InputError('the denoiser returns NaN or infinity')
        z = clipped(uploaded(np.ascontiguousarray(volume)), upper)
        dr.eval(z)
        return z


@dataclass
class NonLocalMeans(Denoiser):
    """Non-local means, by scikit-image: a voxel becomes a mean of those whose surroundings look alike.

    It is slow: the time grows with the cube of 2 distance + 1.

    Parameters
    ----------
    patch : int
        Side of the compared surroundings in voxels, odd, at least 1.
    distance : int
        Distance in voxels up to which other voxels are compared, at least 1.

    Raises
    ------
    InputError
        For an option out of its range.

    References
    ----------
    Buades, Coll and Morel, "A non-local algorithm for image denoising", CVPR 2005; Darbon et al., "Fast nonlocal filtering
    applied to electron cryomicroscopy", ISBI 2008. The filter parameter h is the strength, 1/mm.

    Examples
    --------
    >>> NonLocalMeans().distance
    3
    """

    function: Any = None
    patch: int = 3
    distance: int = 3

    def __post_init__(self):
        check_counts(patch=self.patch, distance=self.distance)
        if self.patch % 2 == 0:
            raise InputError(f'patch must be odd, not {self.patch}')
        self.function = self._means

    def _means(self, volume, strength):
        if strength <= 0:
            return volume
        from skimage.restoration import denoise_nl_means  # a second that other priors need not wait for

        return denoise_nl_means(volume, self.patch, self.distance, h=strength)
