"""ASD-POCS over a volume that is larger than memory: the sweeps of `slab_sweeps`, and descents on total variation.

A step of the descent needs two slices on either side of a slab: one for the gradient, and one more for the gradient after the
step, because the next step needs its length. So a step reads the volume once and writes it once, and slabs exchange only their
outer slices. Lengths, inner products and the largest gradient of the whole volume are sums or maxima over the slabs.

The volume is in four files. Two hold it before the pass and after the sweep of the pass, because the changes by sweep and descent
are compared at the end. Steps read and write the other two in turn.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.geometry.base import Geometry
from lingo_mi.reconstruction.algorithm import Progress
from lingo_mi.reconstruction.fdk import FilteredViews
from lingo_mi.reconstruction.rectify import can_rectify
from lingo_mi.reconstruction.slab_sweeps import Share, SlabSystem, Steps, SweepPlan, path_lengths, summed, sweep
from lingo_mi.reconstruction.slab_volume import Images, Places, SlabFiles, Volume
from lingo_mi.reconstruction.system import dot, evaluated, scalar
from lingo_mi.reconstruction.tv_descent import tv_floor, tv_gradient
from lingo_mi.scan import Scan

PLANES = 2  # slices at either end of a slab that its neighbours read


class Changes(NamedTuple):
    """Lengths of the changes of a pass by the sweep and by the descent, and their inner product."""

    data: float
    descent: float
    product: float


class Balance(Protocol):
    """The decisions of ASD-POCS by its options; see `asd_pocs.ASDPOCS`."""

    @property
    def niter(self) -> int: ...

    @property
    def tviter(self) -> int: ...

    @property
    def alpha(self) -> float: ...

    @property
    def lmbda(self) -> float: ...

    @property
    def lmbda_red(self) -> float: ...

    @property
    def maxl2err(self) -> float | None: ...

    def next_step(self, step: float, changes: Changes, unmatched: Callable[[], bool]) -> float: ...

    def ends(self, lmbda: float, changes: Changes, unmatched: Callable[[], bool]) -> bool: ...


@dataclass(frozen=True)
class DescentPlan(SweepPlan):
    """Passes of ASD-POCS, each a sweep and a descent.

    Parameters
    ----------
    how : Balance
        The options.
    """

    how: Balance

    files: ClassVar[int] = 4

    def system(self, geometry: Geometry, valid: np.ndarray | None, volume: SlabFiles) -> DescentSystem:
        return DescentSystem(geometry, valid, volume)

    def place(self, done: int) -> Places:
        passes, step = divmod(done, self._steps)
        begun, written = 0, self._written(0)
        for _ in range(passes):
            begun = written[-1]
            written = self._written(begun)
        now = written[step - 1] if step else begun if passes else None
        swept = written[self._blocks - 1] if step >= self._blocks else None
        return Places(now, written[step], begun if passes else None, swept)

    def digest(self, scan: Scan, thickness: int) -> str:
        of = super().digest(scan, thickness), self.how
        return hashlib.sha256(repr(of).encode()).hexdigest()

    def complete(self, system: SlabSystem, share: Share, scan: Scan, progress: Progress | None) -> None:
        volume, versions = system.volume, self.how.niter * self._steps
        assert isinstance(volume, Volume)
        if volume.done == versions or volume.numbers.get('ended'):
            return
        steps = Steps(volume.done, versions, len(volume.parts), progress)
        lengths = path_lengths(system, share, scan)
        if 'maxl2err' not in volume.numbers:
            # Before the first update: this writes filtered backprojection where the update will write.
            volume.remember(maxl2err=self._maxl2err(system, share, scan))
        while volume.done < versions and not volume.numbers.get('ended'):
            k, step = divmod(volume.done, self._steps)
            if step < self._blocks:
                blocks = self.updates[k * self._blocks + step : (k + 1) * self._blocks]
                sweep(system, share, scan, lengths, blocks, self.noneg, steps, PLANES)
            self._descend(k, system, share, scan, steps)

    @property
    def _blocks(self):
        """Updates of a sweep."""
        return len(self.updates) // self.how.niter

    @property
    def _steps(self):
        """Versions of the volume that a pass writes."""
        return self._blocks + self.how.tviter

    def _written(self, begun):
        """The files that a pass writes, one after the other. begun: the file of the volume before the pass."""
        a, b, c = (place for place in range(self.files) if place != begun)
        sweep = [(a, b)[i % 2] for i in range(self._blocks)]
        other = b if sweep[-1] == a else a
        return sweep + [(other, c)[i % 2] for i in range(self.how.tviter)]

    def _descend(self, k, system, share, scan, steps):
        """Make the steps of the descent of pass k that are missing."""
        volume, how = system.volume, self.how
        floors, squares = np.array(list(share('begin'))).T
        floor, data = float(floors.max()), float(squares.sum() ** 0.5)
        step = volume.numbers['step'] if k else how.alpha * data
        length = sum(share('squared_gradient', floor)) ** 0.5
        sums = np.zeros(2)
        for i in range(volume.done % self._steps - self._blocks, how.tviter):
            last = i == how.tviter - 1
            scale = -step / length if length else 0.0
            sums = np.sum(list(share('descend', floor, scale, last, slab_done=steps)), 0)
            if not last:
                volume.turn()
                length = sums[0] ** 0.5
        changes = Changes(data, float(sums[0] ** 0.5), float(sums[1]))

        @cache
        def unmatched():
            ax = summed(system, share('project_all', volume.places.swept), scan)
            return _distance(system, scan, ax) > volume.numbers['maxl2err']

        step = how.next_step(step, changes, unmatched)
        volume.turn(step=step, ended=how.ends(how.lmbda * how.lmbda_red ** (k + 1), changes, unmatched))

    def _maxl2err(self, system, share, scan):
        """The largest |A x - b| of a volume that matches the data, see `ASDPOCS`."""
        if self.how.maxl2err is not None:
            return self.how.maxl2err
        if not can_rectify(scan):
            return 0.0
        for _ in share('backproject', share.filtered(scan)):
            pass
        ax = summed(system, share('project_all', system.volume.places.to), scan)
        return 0.2 * _distance(system, scan, ax)


def _distance(system: SlabSystem, scan: Scan, ax: Images) -> float:
    """|A x - b| of all views."""
    squares = 0.0
    for view in range(len(scan)):
        b = system.A.images(scan.views([view])).numpy()
        squares += float(np.square(ax[[view]].ravel() - b, dtype=np.float64).sum())
    return squares**0.5


class DescentSystem(SlabSystem):
    """The work of ASD-POCS on a slab besides the sweeps."""

    def backproject(self, part: int, filtered: FilteredViews) -> None:
        """Write a slab of filtered backprojection in the place of the next version."""
        self.volume.write(part, filtered.slab(self.volume.parts[part]))

    def project_all(self, part: int, place: int) -> Iterator[np.ndarray]:
        """A x of a slab of the version at a place, view by view, float32 [pixel]."""
        return self._by_view(self._projector(part)[0], evaluated(self._load(part, place)))

    def begin(self, part: int) -> np.ndarray:
        """`tv_floor` of a slab after the sweep, and the squared length of its change by the sweep."""
        places = self.volume.places
        begin, end = self.volume.parts[part]
        wide, below = self.volume.read_wide(part, 1, places.swept)
        floor = tv_floor(mi.Float(wide.ravel()), wide.shape)
        swept = wide[:, :, below : below + end - begin]
        change = mi.Float((swept - self.volume.read(part, places.begun)).ravel())
        return np.array([floor[0], dot(change, change)])

    def squared_gradient(self, part: int, floor: float) -> np.ndarray:
        """The squared length of the gradient in a slab."""
        x, below = self.volume.read_wide(part, 1, self.volume.places.now)
        return np.array(self._square(part, mi.Float(x.ravel()), x.shape, below, floor))

    def descend(self, part: int, floor: float, scale: float, last: bool) -> np.ndarray:
        """Write the next version of a slab: add the gradient times `scale`.

        Returns
        -------
        ndarray
            The squared length of the new gradient. After the last step instead: the squared length of the change by the descent,
            and its inner product with the change by the sweep.
        """
        volume, (begin, end) = self.volume, self.volume.parts[part]
        wide, below = volume.read_wide(part, PLANES, volume.places.now)
        x, size = mi.Float(wide.ravel()), wide.shape
        above = size[2] - below - (end - begin)
        gradient = tv_gradient(x, size, mi.Float(floor))
        x = evaluated(dr.fma(scalar(scale), gradient, x))
        del gradient
        wide = x.numpy().reshape(size)
        slab = wide[:, :, below : below + end - begin]
        volume.write(part, slab, 0 if last else PLANES)
        if not last:  # the gradient in the outermost slices is wrong, because it lacks their neighbours
            narrow = wide[:, :, int(below == PLANES) : size[2] - int(above == PLANES)]
            return np.array([self._square(part, mi.Float(narrow.ravel()), narrow.shape, min(below, 1), floor)])
        swept = volume.read(part, volume.places.swept)
        descent, data = (mi.Float(c.ravel()) for c in (slab - swept, swept - volume.read(part, volume.places.begun)))
        return np.array([dot(descent, descent), dot(data, descent)])

    def _square(self, part, x, size, below, floor):
        """The squared length of the gradient in a slab. x: the slab with slices of its neighbours, `below` of them below it."""
        begin, end = self.volume.parts[part]
        gradient = tv_gradient(x, size, mi.Float(floor)).numpy().reshape(size)
        inner = mi.Float(gradient[:, :, below : below + end - begin].ravel())
        return dot(inner, inner)
