"""Adaptive density control: pure functions from state to state, in NumPy.

R2-Gaussian's rules: where the projected centre's mean gradient is large, a small Gaussian is cloned and a large one
split in two. A clone and its original take half the density each, which keeps the mass. The halves of a split are
smaller by 1.6; R2 gives them half the density too, so that three quarters of the mass vanish. Where there is not room
for all, the strongest go first (R2-Gaussian stops). Afterwards faint and stray Gaussians are removed. Adam's moments
travel with their Gaussian; new ones start at zero.

With birth 'halve', which is this project's own, all that are chosen are cut in two along their longest axis instead. Mass,
mean and covariance stay, so that images hardly change, and both halves keep the moments.

For alpha compositing the rules are those of 3DGS: clones and halves keep the opacity, the faint vanish and later the large,
Gaussians outside the volume stay, and from time to time all opacities are lowered (`reset_opacity`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lingo_mi.fitting.activations import inverse_scale, inverse_sigmoid
from lingo_mi.fitting.models import forward_model
from lingo_mi.fitting.settings import Settings
from lingo_mi.fitting.state import State, activate

RESET = 0.01  # 3DGS: opacity that `reset_opacity` leaves at most
APART = 0.7  # distance of a half's centre from its parent's, in the parent's standard deviations
SHRINK = 1.6  # R2-Gaussian (after 3DGS): scale of the halves of a split over their parent's


def densify(
    state: State,
    settings: Settings,
    half: np.ndarray,
    rng: np.random.Generator,
    flat: bool = False,
    largest: float = np.inf,
) -> State:
    """Clone and split, or halve, and prune once, then clear the statistic.

    half      half the volume's sides, [3]: Gaussians centred outside are removed
    rng       numpy Generator; places the halves of splits
    flat      whether all Gaussians lie in the plane z = 0 of a fan beam, and their halves must too
    largest   standard deviation above which the Gaussians of alpha compositing vanish
    """
    control = settings.densification
    mean = np.divide(state.gradient, state.visits, out=np.zeros_like(state.gradient), where=state.visits > 0)
    strong = mean >= control.densify_threshold
    room = max(control.max_gaussians - len(state), 0)  # each adds one
    strong[np.argsort(-mean, kind='stable')[room:]] = False
    if control.birth == 'halve':
        return prune(halve(state, strong, settings, flat), settings, half, largest)
    large = activate(state, settings)[1].max(1) > control.split_size
    state = split(
        clone(state, strong & ~large, settings),
        np.append(strong & large, np.zeros((strong & ~large).sum(), bool)),
        settings,
        rng,
        flat,
    )
    return prune(state, settings, half, largest)


def clone(state: State, chosen: np.ndarray, settings: Settings) -> State:
    """Copy the chosen Gaussians [N] to the end; original and copy get half the density each, or keep the opacity."""
    halved = _shared(state, chosen, 0.5, settings)
    return _append(halved, _fresh(halved, np.flatnonzero(chosen)))


def split(state: State, chosen: np.ndarray, settings: Settings, rng: np.random.Generator, flat: bool = False) -> State:
    """Replace each of the chosen Gaussians [N] by two smaller ones at positions drawn from it."""
    parents = np.flatnonzero(chosen).repeat(2)
    low, high = settings.bounds.scale_min, settings.bounds.scale_max
    centre, scale, rotation, _ = activate(state, settings)
    shrink = np.array([SHRINK, SHRINK, 1.0 if flat else SHRINK])
    children = _fresh(_shared(state, chosen, 0.5, settings), parents)
    offset = rng.normal(size=(len(parents), 3)) * scale[parents]
    if flat:
        offset[:, 2] = 0
    children.values['centre'] = (centre[parents] + _rotate(rotation[parents], offset)).astype(np.float32)
    smaller = np.clip(scale[parents] / shrink, low * 1.01, high * 0.99)
    children.values['scale'] = inverse_scale(smaller, low, high).astype(np.float32)
    return _append(_take(state, ~chosen), children)


def halve(state: State, chosen: np.ndarray, settings: Settings, flat: bool = False) -> State:
    """Replace each of the chosen Gaussians [N] by two, side by side along its longest axis, with its mass and covariance."""
    parents = np.flatnonzero(chosen)
    low, high = settings.bounds.scale_min, settings.bounds.scale_max
    centre, scale, rotation, _ = (x[parents] for x in activate(state, settings))
    axis = np.eye(3)[scale[:, : 2 if flat else 3].argmax(1)]
    shrink = np.where(axis > 0, np.sqrt(1 - APART**2), 1)
    children = _take(_shared(state, chosen, 0.5 / np.sqrt(1 - APART**2), settings), parents.repeat(2))
    offset = _rotate(rotation, APART * axis * scale)
    children.values['centre'] = np.stack([centre + offset, centre - offset], 1).reshape(-1, 3).astype(np.float32)
    smaller = np.clip(scale * shrink, low * 1.01, high * 0.99)
    children.values['scale'] = inverse_scale(smaller, low, high).astype(np.float32).repeat(2, 0)
    children.born[:] = True
    return _append(_take(state, ~chosen), children)


def prune(state: State, settings: Settings, half: np.ndarray, largest: float = np.inf) -> State:
    """Remove Gaussians whose density or opacity is below the bound, and those that the forward model does not let stay: whose
    centre left the volume, or a standard deviation of which is above `largest`. Clear the statistic."""
    centre, scale, _, amount = activate(state, settings)
    stays = forward_model(settings).may_stay(centre, scale, half, largest)
    keep = (amount >= settings.densification.prune_density) & stays
    kept = _take(state, keep)
    kept.gradient[:], kept.visits[:] = 0, 0
    return kept


def reset_opacity(state: State) -> State:
    """Lower all opacities to 0.01 and forget their moments, so that only those that images need come back (3DGS)."""

    def with_opacity(columns, opacity):
        return columns | {'opacity': opacity}

    opacity = state.values['opacity']
    zeros = np.zeros_like(opacity)
    return replace(
        state,
        values=with_opacity(state.values, np.minimum(opacity, np.float32(inverse_sigmoid(RESET)))),
        first=with_opacity(state.first, zeros),
        second=with_opacity(state.second, zeros.copy()),
    )


def _shared(state, chosen, factor, settings):
    """The state with the chosen densities multiplied, where the forward model has densities."""
    values = forward_model(settings).shared(state.values, chosen, factor)
    return replace(state, values=values)


def _take(state, index):
    def pick(columns):
        return {k: v[index] for k, v in columns.items()}

    return State(
        pick(state.values),
        pick(state.first),
        pick(state.second),
        state.gradient[index],
        state.visits[index],
        state.born[index],
    )


def _fresh(state, index):
    """Newborn copies of Gaussians: their parameters, no moments, no statistic."""
    taken = _take(state, index)
    n = len(taken)
    zeros = {k: np.zeros_like(v) for k, v in taken.values.items()}
    return State(
        taken.values,
        zeros,
        {k: v.copy() for k, v in zeros.items()},
        np.zeros(n, np.float32),
        np.zeros(n, np.float32),
        np.ones(n, bool),
    )


def _append(state, more):
    def join(a, b):
        return {k: np.concatenate([v, b[k]]) for k, v in a.items()}

    return State(
        join(state.values, more.values),
        join(state.first, more.first),
        join(state.second, more.second),
        np.concatenate([state.gradient, more.gradient]),
        np.concatenate([state.visits, more.visits]),
        np.concatenate([state.born, more.born]),
    )


def _rotate(q, v):
    """Rotate vectors [N, 3] by unit quaternions (x, y, z, w) [N, 4]."""
    u, w = q[:, :3], q[:, 3:]
    c = 2 * np.cross(u, v)
    return v + w * c + np.cross(u, c)
