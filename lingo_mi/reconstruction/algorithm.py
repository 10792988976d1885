"""What every algorithm is, an object of options, and what it returns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.geometry.base import Geometry
from lingo_mi.scan import Scan

# Called after every step as progress(steps done, steps, |A x - b| / |b| or None where an algorithm does not know it).
Progress = Callable[[int, int, float | None], None]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A volume and how it was reached. `numpy.asarray` of it is the volume.

    volume      float32 [x, y, z], density per mm
    residuals   |A x - b| / |b| at the start and after every iteration (b = 0: |A x|); none for FDK
    seconds     wall-clock time that it took
    geometry    of the scan, whose voxels are those of the volume
    """

    volume: np.ndarray
    residuals: list[float]
    seconds: float
    geometry: Geometry

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.array(self.volume, dtype) if copy else np.asarray(self.volume, dtype)


class Algorithm(ABC):
    """A method of reconstruction: a frozen dataclass, whose fields are its options.

    What it works on, a scan and a start volume, are arguments of `run`, so that one object serves any number of scans. Options
    are checked when the object is made.

    name   by which the command line and `ALGORITHMS` know it
    """

    name: ClassVar[str]

    @abstractmethod
    def run(self, scan: Scan, *, start: ArrayLike | None = None, progress: Progress | None = None) -> Reconstruction:
        """Reconstruct the volume of a scan.

        scan       projections, taken for line integrals, and geometry
        start      volume [x, y, z] to start from, density per mm: an array or what gives one, such as another `Reconstruction`
                   (default: zero)
        progress   called as progress(steps done, `steps`, residual) after every step

        Nothing is asked of the machine or of the projections: `reconstruct` does. Raises InputError for a start that does not
        fit the geometry, and where the result is not finite.
        """

    @property
    def options(self) -> dict[str, Any]:
        """The options by name."""
        return asdict(self)  # type: ignore[call-overload] - of a dataclass, which every algorithm is

    def steps(self, scan: Scan) -> int:
        """How many steps `progress` is told of, at most."""
        return self.options['niter']

    def grid(self, geometry: Geometry) -> Geometry:
        """The geometry with the voxels that are worked on; those of the result are the geometry's own."""
        return geometry
