"""Adaptive density control: pure functions from state to state, in NumPy.

R2-Gaussian's rules: where the mean gradient of the projected centre is large, a small Gaussian is cloned and a large one
is split in two. A clone and its original get half the density each, which keeps the mass. The two halves of a split are
smaller by 1.6. R2 gives them half the density too, so three quarters of the mass vanish (in a fan beam 61 %). If there is
not room for all, those with the largest gradients go first (R2-Gaussian stops). Afterwards faint and stray Gaussians are
removed. Each Gaussian keeps its Adam moments; new ones start at zero.

With `Halve`, every chosen Gaussian is instead cut in two along its longest axis. Mass, mean and covariance stay,
so images hardly change. Both halves keep the moments.

Alpha compositing follows 3DGS: clones and halves keep the opacity. Faint Gaussians are removed, later also large ones;
Gaussians outside the volume stay. All opacities are lowered from time to time (`reset_opacity`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lingo_mi.fitting.activations import inverse_scale, inverse_sigmoid
from lingo_mi.fitting.models.forward import ForwardModel
from lingo_mi.fitting.options.densification import Clone, Densify, Halve
from lingo_mi.fitting.state import State, activate, within

RESET = 0.01  # 3DGS: largest opacity after `reset_opacity`
APART = 0.7  # distance of a half's centre from its parent's, in the parent's standard deviations
SHRINK = 1.6  # R2-Gaussian (after 3DGS): scale of the halves of a split over their parent's


def densify(
    state: State,
    control: Densify,
    forward: ForwardModel,
    half: np.ndarray,
    rng: np.random.Generator,
    flat: bool = False,
    largest: float = np.inf,
) -> State:
    """Clone and split, or halve, and prune once, then clear the statistic.

    Parameters
    ----------
    half : ndarray
        Half the volume's sides, [3]; Gaussians centred outside are removed.
    rng : Generator
        Numpy Generator; places the halves of splits.
    flat : bool
        True for a fan beam: all Gaussians, also new ones, lie in the plane z = 0.
    largest : float
        Alpha compositing: Gaussians with a larger standard deviation are removed.
    """
    mean = np.divide(state.gradient, state.visits, out=np.zeros_like(state.gradient), where=state.visits > 0)
    strong = mean >= control.densify_threshold
    room = max(control.max_gaussians - len(state), 0)  # each adds one
    strong[np.argsort(-mean, kind='stable')[room:]] = False
    if isinstance(control, Halve):
        state = halve(state, strong, forward, flat)
    elif isinstance(control, Clone):
        large = activate(state, forward)[1].max(1) > control.split_size
        state = split(
            clone(state, strong & ~large, forward),
            np.append(strong & large, np.zeros((strong & ~large).sum(), bool)),
            forward,
            rng,
            flat,
        )
    return prune(state, control, forward, half, largest)


def clone(state: State, chosen: np.ndarray, forward: ForwardModel) -> State:
    """Copy the chosen Gaussians [N] to the end; original and copy get half the density each, or keep the opacity."""
    halved = _shared(state, chosen, 0.5, forward)
    return _append(halved, _fresh(halved, np.flatnonzero(chosen)))


def split(
    state: State, chosen: np.ndarray, forward: ForwardModel, rng: np.random.Generator, flat: bool = False
) -> State:
    """Replace each chosen Gaussian [N] by two smaller ones, at positions drawn from it."""
    parents = np.flatnonzero(chosen).repeat(2)
    low, high = forward.bounds.scale_min, forward.bounds.scale_max
    centre, scale, rotation, _ = activate(state, forward)
    shrink = np.array([SHRINK, SHRINK, 1.0 if flat else SHRINK])
    children = _fresh(_shared(state, chosen, 0.5, forward), parents)
    offset = rng.normal(size=(len(parents), 3)) * scale[parents]
    if flat:
        offset[:, 2] = 0
    children.values['centre'] = (centre[parents] + _rotate(rotation[parents], offset)).astype(np.float32)
    smaller = within(scale[parents] / shrink, low * 1.01, high * 0.99)
    children.values['scale'] = inverse_scale(smaller, low, high).astype(np.float32)
    return _append(_take(state, ~chosen), children)


def halve(state: State, chosen: np.ndarray, forward: ForwardModel, flat: bool = False) -> State:
    """Replace each chosen Gaussian [N] by two, side by side along its longest axis. The pair has its mass and covariance."""
    parents = np.flatnonzero(chosen)
    low, high = forward.bounds.scale_min, forward.bounds.scale_max
    centre, scale, rotation, _ = (x[parents] for x in activate(state, forward))
    axis = np.eye(3)[scale[:, : 2 if flat else 3].argmax(1)]
    shrink = np.where(axis > 0, np.sqrt(1 - APART**2), 1)
    children = _take(_shared(state, chosen, 0.5 / np.sqrt(1 - APART**2), forward), parents.repeat(2))
    offset = _rotate(rotation, APART * axis * scale)
    children.values['centre'] = np.stack([centre + offset, centre - offset], 1).reshape(-1, 3).astype(np.float32)
    smaller = within(scale * shrink, low * 1.01, high * 0.99)
    children.values['scale'] = inverse_scale(smaller, low, high).astype(np.float32).repeat(2, 0)
    children.born[:] = True
    return _append(_take(state, ~chosen), children)


def prune(state: State, control: Densify, forward: ForwardModel, half: np.ndarray, largest: float = np.inf) -> State:
    """Remove faint Gaussians (density or opacity below `prune_density`) and stray ones: centre outside the volume or, for alpha
    compositing, a scale above `largest`. Clear the statistic."""
    centre, scale, _, amount = activate(state, forward)
    stays = forward.may_stay(centre, scale, half, largest)
    keep = (amount >= control.prune_density) & stays
    pruned = _take(state, keep)
    pruned.gradient[:], pruned.visits[:] = 0, 0
    return pruned


def reset_opacity(state: State) -> State:
    """Lower all opacities to at most 0.01 and clear their moments (3DGS). Those that the images need rise again."""

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


def _shared(state, chosen, factor, forward):
    """The state with the chosen densities multiplied by `factor`, if the forward model has densities."""
    values = forward.shared(state.values, chosen, factor)
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
