"""The memory that this process may take for its arrays.

psutil knows the memory of the machine on every system, but in a container the control group sets the limit.
"""

from __future__ import annotations

import math
import sys
from os import PathLike
from pathlib import Path

import psutil

from lingo_mi.common.errors import InputError
from lingo_mi.common.gpu import gpu


def room() -> float:
    """Bytes: the GPU's memory if a variant for CUDA is active. Else the smallest of the machine's memory, the limits of the
    control groups that this process is in, and what its limit of address space leaves; infinity if none of them is known."""
    if sys.modules.get('mitsuba') and (sys.modules['mitsuba'].variant() or '').startswith('cuda'):
        return gpu().memory
    return host_room()


def host_room() -> float:
    """Bytes: the smallest of the machine's memory, the limits of the control groups that this process is in, and what its
    limit of address space leaves; infinity if none of them is known."""
    return min(psutil.virtual_memory().total, *_control_groups(), _address_space())


def require_room(needed: float, where: PathLike | str) -> None:
    """Raises InputError, in the name of a file, if reading it would need more bytes than this process may take."""
    if needed > (room := host_room()):
        raise InputError(
            f'{where}: says that it needs {needed / 2**30:,.1f} GiB of memory, but this process may take '
            f'{room / 2**30:,.1f} GiB; if it is not damaged, crop it or use a machine with more memory'
        )


def _control_groups(groups: Path = Path('/proc/self/cgroup'), mounted: Path = Path('/sys/fs/cgroup')) -> list[float]:
    """The limits of this process's control groups, v1 and v2, and of those around them, if they can be read."""
    out = []
    try:
        lines = groups.read_text(encoding='utf-8').splitlines()
    except OSError:
        return out
    for line in lines:
        _, controllers, path = line.split(':', 2)
        if controllers and 'memory' not in controllers.split(','):
            continue
        root, name = (mounted / 'memory', 'memory.limit_in_bytes') if controllers else (mounted, 'memory.max')
        group = root / path.lstrip('/')
        for folder in (group, *group.parents):
            try:
                out.append(float((folder / name).read_text()))
            except (OSError, ValueError):  # not there in a container, or 'max'
                pass
            if folder == root:
                break
    return out


def _address_space() -> float:
    """Return the rest of RLIMIT_AS (`ulimit -v`). Code, and memory that Dr.Jit has set aside, take some of it."""
    try:
        import resource
    except ImportError:  # Windows
        return math.inf
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return math.inf if limit == resource.RLIM_INFINITY else max(limit - psutil.Process().memory_info().vms, 0)
