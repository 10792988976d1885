"""Altered checkpoints."""

import json

import numpy as np

from lingo_mi.fitting.checkpoint import _Crc, checksum_of


def contents(path):
    """All entries of a checkpoint, by name."""
    with np.load(path) as file:
        return dict(file)


def rewrite(path, content, extra=None):
    """Write entries with a right checksum, so that all other checks are reached. extra: other plain values."""
    content = {k: v for k, v in content.items() if k != 'checksum'}
    if extra is not None:
        content['extra'] = np.array(json.dumps(extra))
    checksum = checksum_of((k, _Crc.of(v)) for k, v in content.items())
    np.savez(path, **content, checksum=np.array(checksum))
