"""A weighted sum of priors (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError, require_type
from lingo_mi.reconstruction.parameters import check_counts
from lingo_mi.reconstruction.priors.prior import Prior, check_positive


@dataclass
class PriorSum(Prior):
    """Several priors at once: the sum of weight times R.

    Gradients add up. The proximal map of the sum is computed by applying the maps of the priors in turn, each to what the others
    leave (Dykstra's algorithm).

    Parameters
    ----------
    priors : sequence of Prior
        At least one.
    weights : sequence of float, optional
        One for each prior, above 0 (default: 1).
    inner : int
        Turns in a call, at least 1. A call continues from the variables of the previous one.

    Raises
    ------
    InputError
        For an option out of its range.

    References
    ----------
    Bauschke and Combettes, "A Dykstra-like algorithm for two monotone operators", Pacific J. Optim. 4 (2008).

    Examples
    --------
    >>> from lingo_mi.reconstruction.priors import TV, Huber
    >>> PriorSum((TV(), Huber(1e-3)), weights=(1, 0.5)).curvature
    6000.0
    """

    priors: Sequence[Prior]
    weights: Sequence[float] | None = None
    inner: int = 4

    def __post_init__(self):
        check_counts(inner=self.inner)
        require_type('priors', self.priors, Sequence, 'such as (lm.TV(), lm.Huber(1e-3))')
        if not self.priors:
            raise InputError('priors: give at least one')
        for prior in self.priors:
            require_type('priors', prior, Prior, 'such as lm.TV()')
        if self.weights is not None:
            require_type('weights', self.weights, (Sequence, np.ndarray), 'such as (1, 0.5)')
        weights = (1.0,) * len(self.priors) if self.weights is None else tuple(self.weights)
        if len(weights) != len(self.priors):
            raise InputError(f'weights must be one for each of the {len(self.priors)} priors, not {len(weights)}')
        for weight in weights:
            check_positive('weights', weight)
        self._parts = list(zip(self.priors, weights))
        self.curvature = sum(weight * prior.curvature for prior, weight in self._parts)
        each = [prior.volumes for prior in self.priors]
        self.volumes = (max(each) + sum(each)) / 2 + 2 * len(each)  # about half of it stays while another prior works
        self.begin()

    def begin(self) -> None:
        self._left: list[Any] | None = None
        for prior in self.priors:
            prior.begin()

    def prox(self, x, strength, size, upper=inf):
        parts = [part for part in self._parts if type(part[0]).prox is not Prior.prox]
        if not parts:
            return super().prox(x, strength, size, upper)
        if len(parts) == 1:
            return parts[0][0].prox(x, strength * parts[0][1], size, upper)
        if self._left is None or dr.width(self._left[0]) != dr.width(x):
            self._left = [dr.zeros(mi.Float, dr.width(x)) for _ in parts]
        z = x - sum(self._left)
        for _ in range(self.inner):
            for k, (prior, weight) in enumerate(parts):
                y = z + self._left[k]
                dr.eval(y)
                z = prior.prox(y, strength * weight, size, upper)
                self._left[k] = y - z
                dr.eval(self._left[k])
        return z

    def gradient(self, x, size):
        gradients = [(prior.gradient(x, size), weight) for prior, weight in self._parts]
        terms = [dr.opaque(mi.Float, weight) * g for g, weight in gradients if g is not None]
        if not terms:
            return None
        total = sum(terms[1:], terms[0])
        dr.eval(total)
        return total
