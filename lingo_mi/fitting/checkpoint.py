"""Checkpoints: all that a fit needs to continue exactly as without the interruption."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.fitting.state import State

METRICS, CHECKPOINT = 'metrics.json', 'checkpoint.npz'  # files of a result


def save(path: PathLike | str, state: State, extra: dict, arrays: dict | None = None) -> None:
    """Write a state and plain values (`extra`, as JSON) atomically: after a crash, the previous checkpoint is intact.

    arrays   further NumPy arrays to store, by name

    Raises InputError if it cannot be written.
    """
    path = Path(path)
    columns = {f'{group}.{k}': v for group in ('values', 'first', 'second') for k, v in getattr(state, group).items()}
    temporary = path.with_name(path.name + '.partial')  # left behind only by a kill, then replaced by the next
    try:
        with open(temporary, 'wb') as file:
            np.savez(
                file,
                gradient=state.gradient,
                seen=state.visits,  # the name of earlier versions
                born=state.born,
                extra=np.array(json.dumps(extra, default=np.generic.item)),
                **columns,
                **{f'array.{k}': v for k, v in (arrays or {}).items()},
            )
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError(
            f'{path}: cannot be written ({error.strerror or error}); make room, or name another folder'
        ) from None


def load(path: PathLike | str) -> tuple[State, dict, dict]:
    """The state, the plain values and the further arrays of a checkpoint.

    Raises InputError if the file is missing or is not a checkpoint. Loading never runs code from the file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {k: file[k] for k in file.files}
        names = [k[7:] for k in data if k.startswith('values.')]
        state = State(
            *({k: data[f'{group}.{k}'] for k in names} for group in ('values', 'first', 'second')),
            gradient=data['gradient'],
            visits=data['seen'],
            born=data['born'],
        )
        extra = json.loads(str(data['extra']))
    except FileNotFoundError:
        raise InputError(f'{path}: no such file, so there is no checkpoint to go on from') from None
    except (OSError, KeyError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f'{path}: this is not a checkpoint of a fit ({type(error).__name__}); remove it and start again'
        ) from None
    return state, extra, {k[6:]: v for k, v in data.items() if k.startswith('array.')}
