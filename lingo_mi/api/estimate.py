"""Memory and time of a reconstruction or a fit, before it begins."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any

import drjit as dr

from lingo_mi.common.errors import InputError, require_type, shown
from lingo_mi.common.memory import room
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.completion.prepare import fit_cloud
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.by_name import method_of
from lingo_mi.geometry import Geometry
from lingo_mi.reconstruction import Algorithm, Best, PenalisedLeastSquares, Refined
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.reconstruction.run import mask_images, room_needed, run_algorithm
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.checks import least_memory

EQUAL, CHANGING = (0.7, 1.5), (0.3, 4.0)  # time of future steps over the time of as many trial steps
LEAST_STEPS = 3  # steps of a trial: the first compiles kernels, and does not count


@dataclass(frozen=True)
class Estimate:
    """Memory and time of a reconstruction or a fit.

    Attributes
    ----------
    memory : float
        Peak memory, bytes. The work is refused if it needs more than `room`. For a fit, this is a lower bound.
    room : float
        Bytes that this process may take, on the GPU if one is used.
    seconds : tuple of float or None
        Least and most time. None without a trial.

    Examples
    --------
    `lm.estimate(scan, 'fast').memory / 2**30`
    """

    memory: float
    room: float
    seconds: tuple[float, float] | None = None

    @property
    def fits(self) -> bool:
        """True if the memory suffices."""
        return self.memory <= self.room

    def __repr__(self) -> str:
        time = 'unknown' if self.seconds is None else ' to '.join(map(_duration, self.seconds))
        few = '' if self.fits else ', too much'
        return f'Estimate(memory: {_bytes(self.memory)} of {_bytes(self.room)}{few}; time: {time})'


def estimate(
    scan: Scan | Dataset | Geometry, work: Algorithm | Method | str, *, trial: float | None = None
) -> Estimate:
    """Estimate the memory and the time of `lm.reconstruct(scan, work)` or `lm.fit(scan, work)` before the work.

    Parameters
    ----------
    scan : Scan, Dataset or Geometry
        Of a `Dataset`, `train` is used. A geometry suffices for the memory.
    work : Algorithm, Method or str
        An algorithm such as `lm.SART()`, a method such as `lm.Fast()`, or a method's name, as `lm.fit` takes it.
    trial : float, optional
        The work runs on trial for this many seconds, and for at least three steps. Its pace gives the time, and its result is
        discarded. Without a trial the time is unknown, because it differs between machines by a factor of a hundred.

    Returns
    -------
    Estimate
        `lm.reconstruct`, `lm.fit` and the commands use the same `memory` to refuse work. `seconds` is a range, because later
        steps may take 0.7 to 1.5 times as long as the tried ones. The factor is 0.3 to 4 for fits, `Best` and
        `PenalisedLeastSquares`, because their steps change. A trial waits for the device after every step, so steps of a few
        milliseconds look slower than they are. Work that ends within the trial gives its exact time.

    Raises
    ------
    InputError
        For other types; for a trial that is not positive, lacks a scan, exceeds the memory, or is of `Refined`, which starts from
        a fit; and for all errors of the work.

    Examples
    --------
    >>> import lingo_mi as lm
    >>> g = lm.Geometry.cone(DSO=500, DSD=750, nDetector=512, dDetector=1, nVoxel=512, dVoxel=0.5, angles=lm.circular(50))
    >>> round(lm.estimate(g, lm.SART()).memory / 2**30, 1)
    2.4
    """
    ensure_variant()
    require_type('scan', scan, (Scan, Dataset, Geometry))
    work = method_of(work) if isinstance(work, str) else work
    if not isinstance(work, Algorithm | Method):
        raise InputError(
            f'work must be an algorithm such as lm.SART() or a method such as lm.Fast(), not {shown(work)}'
        )
    scan = scan.train if isinstance(scan, Dataset) else scan
    geometry = scan if isinstance(scan, Geometry) else scan.geometry
    if isinstance(work, Algorithm):
        memory = room_needed(geometry, work, len(geometry), 0 if isinstance(scan, Geometry) else mask_images(scan))
    else:
        memory = least_memory(geometry, len(geometry))
    result = Estimate(float(memory), float(room()))
    if trial is None:
        return result
    _check_trial(scan, work, trial, result)
    assert isinstance(scan, Scan)
    return Estimate(result.memory, result.room, _tried(scan, work, float(trial)))


def _check_trial(scan: Scan | Geometry, work: Algorithm | Method, trial: Any, result: Estimate) -> None:
    if isinstance(trial, bool) or not (isinstance(trial, Real) and 0 < float(trial) < float('inf')):
        raise InputError(f'trial is a time in seconds, above 0, not {shown(trial)}')
    if isinstance(scan, Geometry):
        raise InputError('a trial works on projections: give the scan, not its geometry alone')
    if isinstance(work, Refined):
        raise InputError('refined starts from a fitted cloud, so it cannot be tried: leave out trial')
    if not result.fits:
        raise InputError(f'the trial does not fit into memory, {result!r}: lower nVoxel, nDetector or the views')


class _Enough(Exception):
    """Raised to end a trial."""


def _tried(scan: Scan, work: Algorithm | Method, trial: float) -> tuple[float, float]:
    """Least and most seconds of the work, from its first steps."""
    begun, ends = time.perf_counter(), list[float]()

    def mark(*_, **__):
        dr.sync_thread()
        ends.append(time.perf_counter() - begun)
        if ends[-1] > trial and len(ends) >= LEAST_STEPS:
            raise _Enough

    try:
        _begin(scan, work, mark)
    except _Enough:
        pass
    else:
        took = time.perf_counter() - begun
        return took, took
    total = work.steps(scan) if isinstance(work, Algorithm) else work.iterations
    pace = (ends[-1] - ends[0]) / (len(ends) - 1)
    changing = isinstance(work, Method | Best | PenalisedLeastSquares)
    least, most = CHANGING if changing else EQUAL
    return least * pace * total, ends[-1] + most * pace * (total - len(ends))


def _begin(scan: Scan, work: Algorithm | Method, mark: Callable[..., None]) -> None:
    if isinstance(work, Method):
        run(scan, work, progress=mark, at=())
        return
    inputs: dict[str, Any] = dict(fit=fit_cloud) if isinstance(work, Best) else {}
    run_algorithm(line_integrals(scan), work, progress=mark, **inputs)


def _bytes(count: float) -> str:
    return 'any number' if count == float('inf') else f'{count / 2**30:.3g} GiB'


def _duration(seconds: float) -> str:
    for size, name in ((3600, 'h'), (60, 'min')):
        if seconds >= 2 * size:
            return f'{seconds / size:.2g} {name}'
    return f'{seconds:.2g} s'
