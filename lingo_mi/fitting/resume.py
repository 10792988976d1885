"""Checks whether a fit may continue from a checkpoint."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.fitting.models import forward_model
from lingo_mi.fitting.settings import Settings
from lingo_mi.fitting.state import State


def extensible(settings: Settings) -> bool:
    """Whether a longer fit repeats the steps of a shorter one, so that it can continue from its checkpoint."""
    return settings.decay_steps > 0 and settings.coarse_share == 0 and settings.adam.average == 0


def require_same_fit(host: State, extra: dict, settings: Settings, scanned: dict, seed: int, path: Path) -> None:
    """Raise InputError if a checkpoint belongs to another fit, or is inconsistent."""
    damaged = InputError(f'{path}: this is not a checkpoint of a fit, or it is damaged; remove it and start again')
    if (
        not {'rng', 'seed', 'iteration', 'seconds', 'history', 'info', 'settings', 'views', 'scanner', 'signal'}
        <= extra.keys()
    ):
        raise damaged
    now = settings.flat()
    before = {k: tuple(v) if isinstance(v, list) else v for k, v in extra['settings'].items()}
    free = {'checkpoint_seconds'}
    if extensible(settings) and extra['iteration'] <= settings.iterations:
        free.add('iterations')
    changed = [k for k in now if before.get(k) != now[k] and k not in free]
    if extra['seed'] != seed:
        changed.append('seed')
    if extra['views'] != scanned['views']:
        changed.append('views')
    elif extra['scanner'] != json.loads(json.dumps(scanned['scanner'], default=np.generic.item)):
        changed.append('the geometry')
    elif not math.isclose(
        extra['signal'], scanned['signal'], rel_tol=1e-4
    ):  # simulated anew, their last digits may differ
        changed.append('the projections')
    if changed:
        raise InputError(
            f'{path}: the checkpoint was made with other values of {", ".join(changed)}; resume with the same '
            'settings, or remove it and start again'
        )
    shapes = {k: (len(host), size) for k, size in forward_model(settings).parameters.items()}
    if not (
        len(host.gradient) == len(host.visits) == len(host)
        and all(
            {k: x.shape for k, x in group.items()} == shapes and all(np.isfinite(x).all() for x in group.values())
            for group in (host.values, host.first, host.second)
        )
    ):
        raise damaged
