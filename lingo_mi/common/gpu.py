"""Properties of the GPU that Dr.Jit uses, from the CUDA driver: the first GPU in CUDA_VISIBLE_DEVICES, or the first of all
GPUs.

The driver is asked itself: pynvml knows neither the number of multiprocessors nor CUDA_VISIBLE_DEVICES.
"""

from __future__ import annotations

import ctypes
import os
import sys
from dataclasses import dataclass
from functools import cache

WARP = 32

# Numbers of CUdevice_attribute in cuda.h
_MULTIPROCESSORS, _THREADS, _MAJOR, _MINOR = 16, 39, 75, 76
_CLOCK, _MEMORY_CLOCK, _BUS = 13, 36, 37  # kHz, kHz, bits


@dataclass(frozen=True)
class GPU:
    """A graphics card.

    Parameters
    ----------
    name : str
        As its driver gives it.
    memory : int
        Bytes.
    multiprocessors : int
        Their number.
    warps : int
        Most warps that one of them holds at once.
    capability : int
        Compute capability times ten: 86, 90.
    clock : float
        Clock rate of the multiprocessors, Hz; 0 if the driver does not tell, as below.
    bandwidth : float
        Bandwidth of the memory, bytes a second.
    """

    name: str
    memory: int
    multiprocessors: int
    warps: int
    capability: int
    clock: float
    bandwidth: float


@cache
def gpu() -> GPU:
    """The GPU in use.

    Raises
    ------
    OSError
        If there is no CUDA driver, or no device.
    """
    driver = ctypes.CDLL(_driver())

    def ask(name, *arguments):
        code = getattr(driver, name)(*arguments)
        if code:
            raise OSError(f'the CUDA driver answers {name} with error {code}')

    def attribute(number):
        value = ctypes.c_int()
        ask('cuDeviceGetAttribute', ctypes.byref(value), number, device)
        return value.value

    device, memory, name = ctypes.c_int(), ctypes.c_size_t(), ctypes.create_string_buffer(256)
    ask('cuInit', 0)
    ask('cuDeviceGet', ctypes.byref(device), 0)
    ask('cuDeviceTotalMem_v2', ctypes.byref(memory), device)
    ask('cuDeviceGetName', name, len(name), device)
    warps = (attribute(_THREADS) or 2048) // WARP  # a stand-in for a driver may not say
    capability = 10 * attribute(_MAJOR) + attribute(_MINOR)
    return GPU(
        name=name.value.decode(),
        memory=memory.value,
        multiprocessors=attribute(_MULTIPROCESSORS),
        warps=warps,
        capability=capability,
        clock=1e3 * attribute(_CLOCK),
        bandwidth=2 * 1e3 * attribute(_MEMORY_CLOCK) * attribute(_BUS) / 8,  # twice a cycle
    )


def resident_warps() -> int:
    """The warps that the GPU holds at once, at most."""
    return gpu().multiprocessors * gpu().warps


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them; none if there is no driver."""
    named = os.environ.get('CUDA_VISIBLE_DEVICES')
    if named is not None:
        return [name for name in named.split(',') if name.strip()]
    count = ctypes.c_int()
    try:
        driver = ctypes.CDLL(_driver())
        counted = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
    except OSError:
        return []
    return [str(i) for i in range(count.value)] if counted else []


def _driver() -> str:
    """The library of the CUDA driver, as Dr.Jit loads it."""
    return os.environ.get('DRJIT_LIBCUDA_PATH') or ('nvcuda.dll' if sys.platform == 'win32' else 'libcuda.so.1')
