"""Scattered light as a smooth image, the same in all views.

    m = -ln(exp(-p) + S),    S = sum over i + j <= 2 of s_ij P_i(y) P_j(x)

with Legendre's polynomials P over the panel. S is relative to the open beam. It is told by the object's most absorbing parts.
Where it would be negative it is not light, and a calibration does not take it (`ScatterImage.doubt`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lingo_mi.calibration.response.part import SURE, Place, ResponsePart

DEGREE = 2
ORDERS = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
LEAST_LIGHT = 0.1  # least part of the measured light that is not scatter
EVERYWHERE = Place(*np.meshgrid(*2 * [np.linspace(-1, 1, 41)], indexing='ij'))


@dataclass
class ScatterImage(ResponsePart):
    """The polynomial of second degree: 6 numbers."""

    name = 'scatter'

    @property
    def deviations(self):
        return np.full(len(ORDERS), 0.03)

    def apply(self, p, c, place):
        primary = np.exp(-p)
        return -np.log(np.maximum(primary + self._image(c, place), LEAST_LIGHT * primary))

    def undo(self, m, c, place):
        light = np.exp(-m)
        return -np.log(np.maximum(light - self._image(c, place), LEAST_LIGHT * light))

    def slopes(self, p, c, place):
        primary = np.exp(-p)
        total = np.maximum(primary + self._image(c, place), LEAST_LIGHT * primary)
        return [-basis / total for basis in _bases(place)], primary / total

    def report(self, c):
        return {'scatter_percent_of_open_beam': (100 * c[:, 0]).tolist()}  # the mean over the panel

    def doubt(self, errors):
        image = self._image(self.values[0], EVERYWHERE)
        error = np.sqrt(self._image(errors[0] ** 2, EVERYWHERE, 2))  # as if the numbers were independent
        return 'it would be negative in places' if (image < -SURE * error).any() else ''

    def _image(self, c, place, power=1):
        return sum(x * basis**power for x, basis in zip(c, _bases(place)))


def _bases(place):
    ys, xs = ([np.ones_like(t), t, 1.5 * t**2 - 0.5] for t in (place.y, place.x))
    return [ys[i] * xs[j] for i, j in ORDERS]
