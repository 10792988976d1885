"""Base of the models of a response. NumPy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

VARIES = ('off', 'smooth', 'view')  # how air and gain change from view to view
SMOOTH = 3  # degree in time of smooth air and gain
SURE = 3.0  # a number counts if it is so many standard errors from 0


@dataclass(frozen=True)
class Place:
    """Positions of pixels: y (down) and x over the half-sizes of the panel, from -1 to 1, in the shape of an image or
    [pixels]."""

    y: np.ndarray
    x: np.ndarray


@dataclass
class ResponsePart(ABC):
    """A model that takes a view's line integrals p to what is measured, with K numbers c that may change from view to view.

    Parameters
    ----------
    varies : str
        'view': numbers of every view for itself; 'smooth': polynomials in time; 'one': the same in all views.
    values : ndarray [T, K]
        One row for each view, for each polynomial, or one in all.
    """

    name: ClassVar[str]

    varies: str
    values: np.ndarray = field(init=False)

    @property
    @abstractmethod
    def deviations(self) -> np.ndarray:
        """The expected size of the numbers [K]. It keeps those small that a scan does not determine."""

    @abstractmethod
    def apply(self, p: np.ndarray, c: np.ndarray, place: Place) -> np.ndarray:
        """The measured values of line integrals p [...]."""

    @abstractmethod
    def undo(self, m: np.ndarray, c: np.ndarray, place: Place) -> np.ndarray:
        """The line integrals of measured values m [...]."""

    @abstractmethod
    def slopes(self, p: np.ndarray, c: np.ndarray, place: Place) -> tuple[list[np.ndarray], np.ndarray]:
        """Derivatives of `apply` by each of the numbers, K of [...], and by p, [...]."""

    @abstractmethod
    def report(self, c: np.ndarray) -> dict[str, list[float]]:
        """Physical quantities by name, each [n], of the numbers c [n, K] of n views."""

    def doubt(self, errors: np.ndarray) -> str:
        """Say in words why `values` cannot be true, given their standard errors [T, K]. The text is empty if they can be true."""
        return ''

    def hold(self) -> None:  # noqa: B027 - most models need none
        """Remove from `values` what a scan cannot determine."""
