"""Few wavelet coefficients, by PyWavelets."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

import drjit as dr
import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.projectors.upload import uploaded
from lingo_mi.reconstruction.parameters import check_counts
from lingo_mi.reconstruction.priors.prior import Prior, clipped

MODE = 'periodization'  # the one whose transform is orthonormal


@dataclass
class Wavelets(Prior):
    """The sum of the absolute wavelet coefficients without the coarsest ones, for an orthonormal transform.

    The proximal map is a soft threshold. Each call shifts the volume by another offset, because the blocks of a fixed offset
    would show (cycle spinning). Bounds on the densities are applied after the threshold.

    Parameters
    ----------
    wavelet : str
        PyWavelets' name of an orthogonal wavelet.
    level : int
        Scales, at least 1.
    shifts : bool
        Whether calls shift the volume.

    Raises
    ------
    InputError
        For a wavelet that is unknown or not orthogonal, a level out of its range, and without PyWavelets.

    References
    ----------
    Daubechies, Defrise and De Mol, "An iterative thresholding algorithm for linear inverse problems with a sparsity constraint",
    Comm. Pure Appl. Math. 57 (2004); Coifman and Donoho, "Translation-invariant de-noising", 1995.

    Examples
    --------
    >>> Wavelets('db2', level=2).wavelet  # doctest: +SKIP
    'db2'
    """

    wavelet: str = 'db2'
    level: int = 3
    shifts: bool = True

    def __post_init__(self):
        check_counts(level=self.level)
        pywt = _pywt()
        if self.wavelet not in pywt.wavelist(kind='discrete') or not pywt.Wavelet(self.wavelet).orthogonal:
            raise InputError(
                f"wavelet must be an orthogonal one of PyWavelets, such as 'db2', not {shown(self.wavelet)}"
            )
        self.begin()

    def begin(self) -> None:
        self._offsets = np.random.default_rng(0)

    def prox(self, x, strength, size, upper=inf):
        pywt, block = _pywt(), 2**self.level
        offset = self._offsets.integers(0, block, 3) if self.shifts else (0, 0, 0)
        volume = np.pad(x.numpy().reshape(size), [(0, -n % block) for n in size], mode='edge')
        coefficients = pywt.wavedecn(np.roll(volume, offset, (0, 1, 2)), self.wavelet, MODE, self.level)
        few = [{name: pywt.threshold(c, strength, 'soft') for name, c in scale.items()} for scale in coefficients[1:]]
        back = pywt.waverecn([coefficients[0], *few], self.wavelet, MODE)
        out = np.roll(back, [-o for o in offset], (0, 1, 2))[tuple(map(slice, size))]
        z = clipped(uploaded(np.ascontiguousarray(out, np.float32)), upper)
        dr.eval(z)
        return z


def _pywt() -> Any:
    try:
        import pywt  # imported here, since it may be missing
    except ImportError as error:
        raise InputError("Wavelets needs PyWavelets: pip install '.[wavelets]' in a checkout of lingo_mi") from error
    return pywt
