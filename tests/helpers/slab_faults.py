"""What happens to a worker of a cluster in the middle of a slab; called by `Client.run`."""

import errno
import itertools
import os
import signal
import time

from lingo_mi.files.slabs import SharedZarr
from lingo_mi.reconstruction.slab_volume import PLANES, SlabFiles


def die_in_slab(at, marker):
    """Kill the first worker that writes its `at`-th slab, once it has written half of it."""
    put, calls = SlabFiles._put, itertools.count(1)

    def half(self, name, slices, values):
        if not name.endswith(PLANES) and next(calls) == at and not marker.exists():
            put(self, name, slices, values[..., : values.shape[-1] // 2])
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        put(self, name, slices, values)

    SlabFiles._put = half


def slow_slabs(seconds, marker):
    """Let every slab, and every slab of the OME-Zarr, take so long; the marker says that one has begun."""

    def slow(write):
        def call(*arguments):
            marker.touch()
            time.sleep(seconds)
            write(*arguments)

        return call

    SlabFiles._put, SharedZarr.write = slow(SlabFiles._put), slow(SharedZarr.write)


def full_disk(begin):
    """Let the disk be full where a slab of the OME-Zarr is written that begins at this slice."""
    import zarr

    write = zarr.Array.__setitem__

    def full(array, index, values):
        if isinstance(index, slice) and index.start == begin and array.ndim == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(array, index, values)

    zarr.Array.__setitem__ = full
