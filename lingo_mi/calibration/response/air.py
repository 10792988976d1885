"""Air level and gain of every view.

    m = p + a          a: what air measures; the tube's output is then exp(-a) times the assumed one
    m = (1 + g) p      g: how much more strongly the view attenuates, as for a tube voltage that drifts

A gain that all views have in common is the object's density; its mean is therefore held at 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lingo_mi.calibration.response.part import ResponsePart


@dataclass
class Air(ResponsePart):
    """The air level a."""

    name = 'air'

    @property
    def deviations(self):
        return np.array([0.1])

    def apply(self, p, c, place):
        return p + c[0]

    def undo(self, m, c, place):
        return m - c[0]

    def slopes(self, p, c, place):
        return [np.ones_like(p)], np.ones_like(p)

    def report(self, c):
        return {'air_level': c[:, 0].tolist()}


@dataclass
class Gain(ResponsePart):
    """The gain g."""

    name = 'gain'

    @property
    def deviations(self):
        return np.array([0.05])

    def apply(self, p, c, place):
        return (1 + c[0]) * p

    def undo(self, m, c, place):
        return m / (1 + c[0])

    def slopes(self, p, c, place):
        return [p], np.full_like(p, 1 + c[0])

    def report(self, c):
        return {'gain_percent': (100 * c[:, 0]).tolist()}

    def hold(self):
        if self.varies == 'view':
            self.values -= self.values.mean(0)
        else:  # all polynomials but the constant have no mean over time
            self.values[0] = 0
