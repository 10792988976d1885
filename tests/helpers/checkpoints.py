"""Altered checkpoints."""

import json

import numpy as np


def contents(path):
    """All entries of a checkpoint, by name."""
    with np.load(path) as file:
        return dict(file)


def write_as_before(path, content, extra=None):
    """Write entries as earlier versions did, with neither version nor checksum. extra: other plain values."""
    content = {k: v for k, v in content.items() if k != 'checksum'}
    if extra is None and 'extra' in content:
        extra = json.loads(str(content['extra']))
    if extra is not None:
        known = {k: v for k, v in extra.items() if k != 'version'} if isinstance(extra, dict) else extra
        content['extra'] = np.array(json.dumps(known))
    np.savez(path, **content)
