"""Faults of a cluster's worker in the middle of a slab; called by `Client.run`."""

import errno
import itertools
import os
import signal
import time

import zarr

from lingo_mi.files.slabs import SharedZarr
from lingo_mi.reconstruction.slab_volume import PLANES, SlabFiles

PUT, WRITE, SET = SlabFiles._put, SharedZarr.write, zarr.Array.__setitem__


def undo():
    """Let this worker work as before."""
    SlabFiles._put, SharedZarr.write, zarr.Array.__setitem__ = PUT, WRITE, SET


def die_in_slab(at, marker):
    """Kill the first worker that writes its `at`-th slab, once it has written half of it."""
    calls = itertools.count(1)

    def half(self, name, slices, values):
        if not name.endswith(PLANES) and next(calls) == at and not marker.exists():
            PUT(self, name, slices, values[..., : values.shape[-1] // 2])
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        PUT(self, name, slices, values)

    SlabFiles._put = half


def slow_slabs(seconds, marker):
    """Let every slab take so long, in the volume and in the OME-Zarr; the marker says that one has begun."""

    def slow(write):
        def call(*arguments):
            marker.touch()
            time.sleep(seconds)
            write(*arguments)

        return call

    SlabFiles._put, SharedZarr.write = slow(PUT), slow(WRITE)


def full_disk(begin):
    """Let the disk be full where a slab of the OME-Zarr is written that begins at this slice."""

    def full(array, index, values):
        if isinstance(index, slice) and index.start == begin and array.ndim == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        SET(array, index, values)

    zarr.Array.__setitem__ = full
