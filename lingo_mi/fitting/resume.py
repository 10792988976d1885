"""Checks whether a fit may continue from a checkpoint."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.settings import Settings
from lingo_mi.scan import Scan


def extensible(settings: Settings, scatters: bool = False) -> bool:
    """Whether a longer fit repeats the steps of a shorter one, so that it can continue from its checkpoint.

    scatters   whether the fit models scattered light, which is renewed at shares of the iterations
    """
    plain = settings.coarse_share == 0 and settings.adam.average == 0 and settings.stopping.stop == 'off'
    return plain and settings.decay_steps > 0 and not settings.calibration.responds and not scatters


def moments(projections: np.ndarray) -> list[float]:
    """Means of the projections times the view's, the row's and the column's number, from 0 to 1: they tell apart what has one
    mean."""
    p = (
        projections.mean((1, 2), dtype=float),
        projections.mean((0, 2), dtype=float),
        projections.mean((0, 1), dtype=float),
    )
    return [float(np.mean(x * np.linspace(0, 1, len(x)))) for x in p]


def traits(scan: Scan) -> dict[str, str | None]:
    """Tells scans of the same projections apart: digests of the valid pixels and of the effects, as plain values."""
    e = scan.effects
    named = None
    if e is not None:
        named = [e.tube and e.tube.given, e.spot and vars(e.spot), e.scatter and e.scatter.given]
        named.append(e.detector and vars(e.detector))
    return dict(
        valid=None if scan.valid is None else hashlib.sha256(np.packbits(scan.valid).tobytes()).hexdigest(),
        effects=None if named is None else hashlib.sha256(json.dumps(named, default=str).encode()).hexdigest(),
    )


def require_same_fit(
    extra: dict, settings: Settings, scanned: dict, seed: int, path: Path, scatters: bool = False
) -> None:
    """Raise InputError if a checkpoint, by its plain values, belongs to another fit. scatters: as of `extensible`."""
    now = settings.flat()
    # Settings that the checkpoint does not know are newer than it; what they stand at changes nothing.
    before = Settings().flat() | {k: tuple(v) if isinstance(v, list) else v for k, v in extra['settings'].items()}
    free = {'checkpoint_seconds'}
    if extensible(settings, scatters) and extra['iteration'] <= settings.iterations:
        free.add('iterations')
    changed = [k for k in now if before.get(k) != now[k] and k not in free]
    if extra['seed'] != seed:
        changed.append('seed')
    if extra['views'] != scanned['views']:
        changed.append('views')
    elif extra['scanner'] != json.loads(json.dumps(scanned['scanner'], default=np.generic.item)):
        changed.append('the geometry')
    elif not np.allclose(
        [extra['signal'], *extra.get('moments', scanned['moments'])],  # earlier checkpoints have no moments
        [scanned['signal'], *scanned['moments']],
        rtol=1e-4,  # simulated anew, their last digits may differ
        atol=1e-4 * abs(scanned['signal']),
    ):
        changed.append('the projections')
    known = extra.get('traits', scanned['traits'])  # earlier checkpoints have none
    changed += [
        what
        for name, what in dict(valid='the valid pixels', effects='the effects of the scan').items()
        if known[name] != scanned['traits'][name]
    ]
    if changed:
        raise InputError(
            f'{path}: the checkpoint was made with other values of {", ".join(changed)}; resume with the same '
            'settings, or remove it and start again'
        )
