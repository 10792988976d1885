"""The state of a fit: all that a step changes, and the conversion of raw parameters to Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lingo_mi.fitting.activations import inverse_scale, sigmoid
from lingo_mi.fitting.models.forward import ForwardModel


@dataclass
class State:
    """N Gaussians under optimisation, on the host: NumPy arrays, float32 but for `born`. Of a neural field N is 0.

    Parameters
    ----------
    values : dict[str, ndarray]
        Raw parameters by name, [N, size]; see `lingo_mi.fitting.models` and `activate`. Those of a neural field have their own
        lengths, see `lingo_mi.fitting.field.network`.
    first, second : dict[str, ndarray]
        Adam's moments, like `values`.
    gradient, visits : ndarray
        Densification statistic [N]: sum of the norms of the projected centre's gradient, and number of views in which the
        Gaussian was visible.
    born : ndarray
        Whether densification made the Gaussian [N].
    """

    values: dict[str, np.ndarray]
    first: dict[str, np.ndarray]
    second: dict[str, np.ndarray]
    gradient: np.ndarray
    visits: np.ndarray
    born: np.ndarray = field(repr=False)

    def __len__(self) -> int:
        return len(self.born)


def start(points: np.ndarray, spacing: np.ndarray, density: np.ndarray | None, forward: ForwardModel) -> State:
    """The state at the start of a fit: isotropic Gaussians, unrotated, with zero moments.

    points [N, 3]; spacing [N], standard deviations; density [N] at the centres, in the fit's unit (None for alpha
    compositing). All in the normalised frame.
    """
    low, high = forward.bounds.scale_min, forward.bounds.scale_max
    n = len(points)
    scale = within(spacing, low + 1e-5, high - 1e-5)[:, None].repeat(3, 1)
    values = dict(
        centre=np.asarray(points),
        scale=inverse_scale(scale, low, high),
        rotation=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        **forward.initial(n, density),
    )
    values = {k: np.ascontiguousarray(v, np.float32) for k, v in values.items()}
    zeros = {k: np.zeros_like(v) for k, v in values.items()}
    return State(
        values,
        zeros,
        {k: v.copy() for k, v in zeros.items()},
        np.zeros(n, np.float32),
        np.zeros(n, np.float32),
        np.zeros(n, bool),
    )


def activate(state: State, forward: ForwardModel) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Centres, standard deviations, unit quaternions (x, y, z, w) and densities or opacities, float64 [N, ...].

    Scales are a sigmoid between the bounds (R2-Gaussian). The forward model gives densities or opacities.
    """
    low, high = forward.bounds.scale_min, forward.bounds.scale_max
    centre, scale, rotation = (state.values[k].astype(float) for k in ('centre', 'scale', 'rotation'))
    rotation = rotation / np.linalg.norm(rotation, axis=1, keepdims=True)
    return centre, low + (high - low) * sigmoid(scale), rotation, forward.amount(state.values)


def within(scale: np.ndarray, low: float, high: float) -> np.ndarray:
    """Standard deviations from `low` to `high`; of bounds so close that these cross, their mean."""
    return np.clip(scale, low, high) if low < high else np.full_like(scale, (low + high) / 2)
