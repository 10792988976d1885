"""Sums over the views of a step: losses, gradients and statistics, made on this device or elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import mitsuba as mi

if TYPE_CHECKING:
    from lingo_mi.fitting.step import GaussianStepper


class Statistic(Protocol):
    """Target of the densification statistic: `State.gradient` and `State.visits`, Float [N]."""

    gradient: Any
    visits: Any


class ViewSums(Protocol):
    """The sums over some views of a scan: on this device (`ViewsHere`), or on workers (`view_cluster.ViewsOnWorkers`)."""

    def add(
        self, fit: GaussianStepper, leaf: tuple, statistic: Statistic, views: Sequence[int], batch: int, iteration: int
    ) -> tuple[Any, Any]:
        """Add the gradients of some views to the Gaussians' gradients, and their statistic to the fit's statistic.

        Parameters
        ----------
        fit : GaussianStepper
            The optimisation.
        leaf : tuple
            The Gaussians of `ForwardModel.gaussians`, with gradients enabled.
        statistic : Statistic
            Target of norms and visits.
        views : sequence of int
            Numbers of the views.
        batch : int
            Views in the whole step; the loss is their mean.
        iteration : int
            Counts from 0.

        Returns
        -------
        loss : Float [1]
            The views' part of the mean, not multiplied by the loss scale.
        factor : Float [1] or None
            The views' part of the mean loss scale; None without a dynamic one.
        """
        ...


class ViewsHere:
    """The sums over views on this device."""

    def add(
        self, fit: GaussianStepper, leaf: tuple, statistic: Statistic, views: Sequence[int], batch: int, iteration: int
    ) -> tuple[Any, Any]:
        """See `ViewSums.add`."""
        total, factors = mi.Float(0), []
        for view in views:
            target = fit.targets[view]
            for correction in fit.corrections:
                correction.before_view(fit, target, view)
            loss, norm, visible, factor = fit.compare(leaf, target, batch)
            total += loss
            factors.append(factor)
            statistic.gradient += norm
            statistic.visits += visible
            for correction in fit.corrections:
                correction.after_view(fit, target, view, iteration)
        return total, sum(factors) if fit.method.loss.loss_scale == 'dynamic' else None
