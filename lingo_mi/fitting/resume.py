"""Checks whether a fit may go on from a checkpoint."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import effects_of
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.method import Method
from lingo_mi.scan import Scan
from lingo_mi.scene.description import describe


def identity(scan: Scan) -> dict:
    """Return plain values that tell a scan from others of the same geometry: the number of views, mean and moments of the
    projections, and digests of the valid pixels and of the effects."""
    e = effects_of(scan)
    named = None
    if e is not None:
        named = [e.tube and e.tube.parameters, e.spot and vars(e.spot), e.scatter and e.scatter.parameters]
        named.append(e.detector and vars(e.detector))
    return dict(
        views=len(scan),
        signal=float(scan.projections.mean(dtype=float)),
        moments=_moments(scan.projections),
        valid=None if scan.valid is None else hashlib.sha256(np.packbits(scan.valid).tobytes()).hexdigest(),
        effects=None if named is None else hashlib.sha256(json.dumps(named, default=str).encode()).hexdigest(),
    )


def _moments(projections: np.ndarray) -> list[float]:
    """Means of the projections times the view's, the row's and the column's number, from 0 to 1: they tell apart what has one
    mean."""
    p = (
        projections.mean((1, 2), dtype=float),
        projections.mean((0, 2), dtype=float),
        projections.mean((0, 1), dtype=float),
    )
    return [float(np.mean(x * np.linspace(0, 1, len(x)))) for x in p]


def require_same_fit(stored: Checkpoint, method: Method, scan: Scan, seed: int, path: Path) -> None:
    """Raise InputError if a checkpoint is of another fit.

    Parameters
    ----------
    method : Method
        With the limits that the scan sets.
    path : Path
        Path of the checkpoint, for the message.
    """
    before, now = stored.method.flat(), method.flat()
    free = {'checkpoint_seconds'}
    # Scattered light is estimated after shares of the iterations.
    scatters = stored.effects and (e := effects_of(scan)) is not None and e.scatter is not None
    if method.extensible and not scatters and stored.iteration <= method.iterations:
        free.add('iterations')
    changed = ['the method'] if stored.method.name != method.name else []
    if not changed:
        changed += [k for k in now if before.get(k) != now[k] and k not in free]
    if stored.seed != seed:
        changed.append('seed')
    was, is_now = stored.scan, identity(scan)
    if was['views'] != is_now['views']:
        changed.append('views')
    elif _plain(describe(stored.geometry)) != _plain(describe(scan.geometry)):
        changed.append('the geometry')
    elif not np.allclose(
        [was['signal'], *was['moments']],
        [is_now['signal'], *is_now['moments']],
        rtol=1e-4,  # simulated anew, their last digits may differ
        atol=1e-4 * abs(is_now['signal']),
    ):
        changed.append('the projections')
    names = dict(valid='the valid pixels', effects='the effects of the scan')
    changed += [what for name, what in names.items() if was[name] != is_now[name]]
    if changed:
        raise InputError(
            f'{path}: the checkpoint was made with other values of {", ".join(changed)}; resume with the same '
            'settings, or remove it and start again'
        )


def _plain(values: dict) -> dict:
    return json.loads(json.dumps(values, default=np.generic.item))
