"""The interface of all methods: a frozen dataclass with its options, which makes what a fit needs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from typing_extensions import Self

from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.corrections.poses import Poses
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.measured import knows_noise, trusted
from lingo_mi.fitting.models.model import Model
from lingo_mi.fitting.options.part import MOST_STEPS, Part
from lingo_mi.fitting.options.rates import Rates, between
from lingo_mi.fitting.options.stopping import Stopping
from lingo_mi.fitting.state import State
from lingo_mi.fitting.view_order import ORDERS
from lingo_mi.geometry.base import Geometry
from lingo_mi.jobs.cluster import Cluster
from lingo_mi.reconstruction.held_out import LEAST_VIEWS
from lingo_mi.scan import Scan


@dataclass(frozen=True)
class Method(Part, ABC):
    """A way to fit a scan. `lm.fit(scan, method)` runs it.

    A method is a frozen dataclass. Its options are fields, and options that belong together are parts, such as `stopping`. So
    one object serves any number of scans, and a new method is a dataclass with other defaults, other parts, or another
    `stepper`.

    Parameters
    ----------
    iterations : int
        Adam steps.
    batch : int
        Views in a step.
    view_order : {'random', 'golden'}
        'golden': any few views in a row lie well apart; see `lingo_mi.fitting.view_order`.
    checkpoint_seconds : float
        Time between checkpoints.
    stopping : Stopping
        Whether, and when, the fit stops earlier.
    rates : Rates
        Adam's step sizes.

    Attributes
    ----------
    name : str
        On the command line and in files.
    makes_volume : bool
        Whether a fit makes a volume, besides views.
    makes_gaussians : bool
        Whether the parameters are Gaussians.
    effects : {'model', 'ignore'}
        'model': the fit models the effects that the scene declares (spectrum, focal spot, blur, dead pixels). 'ignore': it takes
        all projections for line integrals.
    """

    RANGES: ClassVar = dict(iterations=(1, MOST_STEPS), batch=(1, 1e6), checkpoint_seconds=(0, 1e9))
    CHOICES: ClassVar = dict(view_order=ORDERS)
    makes_volume: ClassVar[bool] = True
    makes_gaussians: ClassVar[bool] = True
    effects: ClassVar[str] = 'ignore'

    iterations: int = 30_000
    batch: int = 1
    view_order: str = 'random'
    checkpoint_seconds: float = 30.0
    stopping: Stopping = Stopping()
    rates: Rates = Rates()

    @abstractmethod
    def stepper(self, scan: Scan) -> Stepper:
        """Return the optimisation on a scan.

        Parameters
        ----------
        scan : Scan
            The views to fit.

        Returns
        -------
        Stepper
            Before its first step.

        Raises
        ------
        InputError
            For a scan that cannot be fitted.
        """

    @abstractmethod
    def model(self, geometry: Geometry, unit: float, effects: Effects | None = None) -> Model:
        """Return the model that renders and voxelizes a state of a fit.

        Parameters
        ----------
        geometry : Geometry
            Geometry of the fitted scan.
        unit : float
            The density that the fit counts as 1, in 1/mm.
        effects : Effects or None
            The effects of the scan that the fit models.

        Returns
        -------
        Model
            A model without parameters; its calls take a state.
        """

    def poses(self, geometry: Geometry) -> Poses | None:
        """Return the corrections of the views' poses at the start.

        Parameters
        ----------
        geometry : Geometry
            Geometry of the scan.

        Returns
        -------
        Poses or None
            All zero; None if the fit corrects no poses.
        """
        return None

    @abstractmethod
    def shapes(self, count: int) -> dict[str, tuple[int, int]]:
        """Return the shapes of the parameters.

        Parameters
        ----------
        count : int
            Number of Gaussians.

        Returns
        -------
        dict[str, tuple[int, int]]
            (rows, columns) of each parameter, by name.
        """

    def bounded(self, scan: Scan) -> Self:
        """Return the method with the limits that a scan sets.

        Parameters
        ----------
        scan : Scan
            The views to fit.

        Returns
        -------
        Method
            A copy, in which `stop` is 'on' or 'off'.

        Raises
        ------
        InputError
            If a step has more views than the scan, for stop='on' if views cannot be held out, and if memory does not suffice.
        """
        if self.batch > len(scan):
            raise InputError(
                f'batch is the number of views in a step: at most the {len(scan)} of the scan, not {self.batch}'
            )
        stops = self._stops(scan)
        return replace(self, stopping=replace(self.stopping, stop='on' if stops else 'off'))

    def _stops(self, scan: Scan) -> bool:
        """Return whether a fit stops early, by held-out views."""
        stop, valid = self.stopping.stop, trusted(scan, self.effects).valid
        views = len(scan) if valid is None else int(valid.any((1, 2)).sum())
        why = None
        if views < LEAST_VIEWS:
            why = f'needs at least {LEAST_VIEWS} with valid pixels, but the scan has {views}'
        elif self.frees_views:
            why = 'cannot know their poses: take pose_motion=smooth'
        if stop == 'on' and why:
            raise InputError(f'stop=on holds views out, and {why}; else leave stop=on out')
        return stop == 'on' or stop == 'auto' and not why and knows_noise(scan)

    def require_batch(self) -> None:
        """Raise InputError if a step has one view, which workers cannot divide."""
        if self.batch == 1:
            raise InputError(
                'cluster= divides the views of a step among workers, and a step has 1 view: set batch=N, or leave cluster out'
            )

    @property
    def frees_views(self) -> bool:
        """True if every view has a pose of its own to fit, so that no view can be predicted from others."""
        return False

    @property
    def extensible(self) -> bool:
        """True if a longer fit repeats the steps of a shorter one, so that it can go on from its checkpoint."""
        return self.rates.average == 0 and self.rates.decay_steps > 0 and self.stopping.stop == 'off'

    def rate(self, name: str, iteration: int) -> float:
        """Return Adam's step size for a parameter.

        Parameters
        ----------
        name : str
            Name of the parameter, such as 'centre'.
        iteration : int
            Iteration, counted from 0.

        Returns
        -------
        float
            Between the first and the last value of `rates.rate_NAME`.
        """
        return self.falling(getattr(self.rates, f'rate_{name}'), iteration)

    def falling(self, pair: tuple[float, float], iteration: int) -> float:
        """Return the rate at an iteration between the first and the last of a pair.

        Parameters
        ----------
        pair : tuple[float, float]
            First and last rate.
        iteration : int
            Iteration, counted from 0.

        Returns
        -------
        float
            The rate, which falls log-linearly.
        """
        return between(pair, min(iteration / max(self.rates.decay_steps or self.iterations, 1), 1.0))


class Stepper(ABC):
    """The optimisation of a method on one scan, step by step.

    Attributes
    ----------
    method : Method
        As used, with lengths in the normalised frame.
    geometry : Geometry
        Geometry of the scan.
    model : Model
        Model of the fit.
    """

    method: Method
    geometry: Geometry
    model: Model

    @abstractmethod
    def begin(self, seed: int) -> tuple[State, np.ndarray, dict]:
        """The state to start from; the points that it starts from, float32 [N, 3], normalised; and what the start measured."""

    @abstractmethod
    def step(self, state: DeviceState, views: Sequence[int], iteration: int, rng: np.random.Generator) -> Any:
        """Advance the state by one step on the views. Returns the loss, Float [1], not yet evaluated.

        `iteration` counts from 0. `rng` makes all random choices of the step.
        """

    def divide(self, cluster: Cluster, method: Method) -> None:
        """Let the workers of a cluster do the views of each step from now on.

        Parameters
        ----------
        method : Method
            The method that made this stepper.

        Raises
        ------
        InputError
            If the steps cannot be divided.
        """
        raise InputError(
            f'cluster= divides the views of a fit of Gaussians among workers, but {method.name} has none: leave cluster out'
        )

    def densified(self, state: DeviceState, iteration: int, rng: np.random.Generator) -> DeviceState | None:
        """The state after Gaussians were added or removed; None if that is not due at this iteration."""
        return None

    def corrected(self) -> Geometry:
        """The scan's geometry with the poses that were corrected so far."""
        return self.geometry

    def between(self, geometry: Geometry) -> Geometry:
        """A geometry with corrections for the time of its views, which were taken during the scan."""
        return geometry

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays that steps keep besides the state, by name, for a checkpoint."""
        return {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:  # noqa: B027 - most keep nothing
        """Restore the output of `arrays`."""
