"""The views of a step on the workers of a cluster.

Every worker keeps the scan on its device. In a step it receives the Gaussians, renders and differentiates its part of the views,
and returns sums. This process adds the sums and updates the Gaussians, so a step has the result of one process, up to the order
of additions. For each Gaussian with a density, a worker receives 11 numbers and returns 13: 96 bytes a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.runtime import drjit_lock
from lingo_mi.fitting.device_state import download, upload
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.view_sums import Statistic
from lingo_mi.projectors.backprop import leaves
from lingo_mi.projectors.upload import uploaded
from lingo_mi.scan import Scan

if TYPE_CHECKING:
    from lingo_mi.fitting.step import GaussianStepper


@dataclass(frozen=True)
class Sums:
    """Sums that `ViewSums.add` adds and returns, on the host.

    Parameters
    ----------
    gradients : dict[str, ndarray]
        Gradients by the Gaussians' parameters, float32 [N, size].
    statistic : ndarray
        Norms and visits, float32 [2, N].
    scalars : ndarray
        The loss and, if it is dynamic, the loss scale, float32 [1] or [2].
    """

    gradients: dict[str, np.ndarray]
    statistic: np.ndarray
    scalars: np.ndarray

    def __add__(self, other: Sums) -> Sums:
        gradients = {name: g + other.gradients[name] for name, g in self.gradients.items()}
        return Sums(gradients, self.statistic + other.statistic, self.scalars + other.scalars)


class ViewsOfWorker:
    """The measured views on one worker, which loads them when it first needs them.

    Parameters
    ----------
    method : Method
        The method of the fit.
    scan : Scan
        All views of the fit.
    """

    def __init__(self, method: Method, scan: Scan):
        self._method, self._scan = method, scan
        self._stepper: Any = None

    @drjit_lock()
    def sums(self, views: Sequence[int], values: dict[str, np.ndarray], batch: int, iteration: int) -> Sums:
        """The sums over some views for Gaussians given by name, float32 [N, size]. The rest as in `ViewSums.add`."""
        if self._stepper is None:
            self._stepper = self._method.stepper(self._scan)
        leaf = leaves(upload(values).values())
        n = dr.width(leaf[0])
        statistic: Any = SimpleNamespace(gradient=dr.zeros(mi.Float, n), visits=dr.zeros(mi.Float, n))
        loss, factor = self._stepper.views.add(self._stepper, leaf, statistic, views, batch, iteration)
        gradients = [dr.grad(x) for x in leaf]
        dr.eval(gradients, statistic.gradient, statistic.visits, loss, factor)
        return Sums(
            download(dict(zip(values, gradients))),
            np.stack([statistic.gradient.numpy(), statistic.visits.numpy()]),
            np.concatenate([x.numpy() for x in (loss, factor) if x is not None]),
        )


class Workers(Protocol):
    """A `ViewsOfWorker` on each worker: `jobs.actors.Actors`."""

    def divided(self, method: str, items: Sequence[int], *arguments: Any) -> list[Sums]: ...


class ViewsOnWorkers:
    """The sums over views on the workers of a cluster: see `ViewSums`.

    Parameters
    ----------
    names : sequence of str
        The Gaussians' parameters, in the order of `ForwardModel.gaussians`.
    """

    def __init__(self, workers: Workers, names: Sequence[str]):
        self._workers, self._names = workers, names

    def add(
        self, fit: GaussianStepper, leaf: tuple, statistic: Statistic, views: Sequence[int], batch: int, iteration: int
    ) -> tuple[Any, Any]:
        """See `ViewSums.add`."""
        detached = dr.detach(leaf)
        dr.eval(detached)
        values = download(dict(zip(self._names, detached, strict=True)))
        first, *others = self._workers.divided('sums', views, values, batch, iteration)
        total = sum(others, start=first)
        for x, gradient in zip(leaf, upload(total.gradients).values()):
            dr.accum_grad(x, gradient)
        norms, visits = map(uploaded, total.statistic)
        statistic.gradient += norms
        statistic.visits += visits
        loss, factor = [uploaded(x) for x in total.scalars[:, None]] + [None] * (2 - len(total.scalars))
        return loss, factor
