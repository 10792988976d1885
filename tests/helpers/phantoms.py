"""Phantoms that are made once: each takes a second or two, even of 16 voxels a side, and hundreds of tests start with one."""

import contextlib
import functools
import importlib
from unittest import mock

NAMES = 'chest', 'foot'


@functools.cache
def _made(build, size, seed):
    return build(size, seed)


def _once(build):
    def make(size, seed=0):
        data, *rest = _made(build, size, seed)
        return data.copy('K'), *rest

    return make


@contextlib.contextmanager
def made_once():
    """Within it a phantom of a size and a seed is made once in this process, and copied."""
    with contextlib.ExitStack() as stack:
        for name in NAMES:
            module = importlib.import_module(f'lingo_mi.phantoms.{name}')
            stack.enter_context(mock.patch.object(module, 'build', _once(module.build)))
        yield


def forget():
    """The next phantoms are made anew."""
    _made.cache_clear()
