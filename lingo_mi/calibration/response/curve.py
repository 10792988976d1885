"""The curve between line integral and measured value, as for beam hardening by one material of an unknown spectrum.

    m = p + c2 p^2 + c3 p^3 + ...

(as Herman, Phys. Med. Biol. 24, 1979, corrects by a polynomial). The slope at 0 is 1, which defines the density. The curve rises
everywhere from 0 to the highest line integral: coefficients that let it fall are made smaller.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lingo_mi.calibration.response.part import ResponsePart

LEAST_SLOPE = 0.2
NEWTON = 8  # steps of the inverse


@dataclass
class Curve(ResponsePart):
    """The polynomial of `count` coefficients, from the square on, up to the line integral `highest`."""

    name = 'curve'

    count: int = 1
    highest: float = 1.0

    @property
    def deviations(self):
        return 0.5 / self.highest ** (1.0 + np.arange(self.count))

    def apply(self, p, c, place):
        q = np.clip(p, 0, self.highest)  # beyond, the curve goes on straight
        return self._polynomial(q, c) + (p - q) * self._slope(q, c)

    def undo(self, m, c, place):
        p = np.array(m, float)
        for _ in range(NEWTON):
            p -= (self.apply(p, c, place) - m) / self._slope(np.clip(p, 0, self.highest), c)
        return p

    def slopes(self, p, c, place):
        q = np.clip(p, 0, self.highest)
        by_numbers = [q ** (k + 2) + (p - q) * (k + 2) * q ** (k + 1) for k in range(self.count)]
        return by_numbers, self._slope(q, c)

    def report(self, c):
        drop = [1 - float(self._polynomial(self.highest, row)) / self.highest for row in c]
        return {'hardening_percent_at_highest': [100 * x for x in drop]}

    def hold(self):
        q = np.linspace(0, self.highest, 101)
        for row in self.values:
            lowest = self._slope(q, row).min()
            if lowest < LEAST_SLOPE:
                row *= (1 - LEAST_SLOPE) / (1 - lowest)

    def _polynomial(self, q, c):
        return q + sum(x * q ** (k + 2) for k, x in enumerate(c))

    def _slope(self, q, c):
        return np.ones_like(q) + sum(x * (k + 2) * q ** (k + 1) for k, x in enumerate(c))
