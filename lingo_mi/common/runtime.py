"""Backend choice: find libLLVM before Dr.Jit loads, and choose a variant of Mitsuba."""

from __future__ import annotations

import ctypes
import glob
import os
import re
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from lingo_mi.common.errors import InputError

OLDEST_LLVM = 17  # Dr.Jit 1.5 refuses LLVM 14; 15 and 16 abort the process on ordinary kernels
LLVM_HELP = (
    'On the CPU, Dr.Jit needs LLVM 17 or newer: `pip install karellen-llvm-core` on Linux x86-64, `apt install libllvm19` on '
    'other Linux, `brew install llvm` on macOS, `winget install LLVM.LLVM` on Windows; DRJIT_LIBLLVM_PATH names the shared '
    'library of another one.'
)

# Below the folder of an environment: pip's karellen-llvm-core, and conda's libllvm.
_IN_ENVIRONMENT = {'darwin': ('lib/libLLVM.*dylib',), 'win32': ('Library/bin/LLVM-C*.dll',)}
_LINUX = 'lib/libLLVM.so*', 'lib/libLLVM-*.so'
# Folders of Homebrew and of the installer for Windows, which Dr.Jit does not search.
_INSTALLED = {'darwin': '/opt/homebrew/opt/llvm/lib/libLLVM.dylib', 'win32': r'C:\Program Files\LLVM\bin\LLVM-C.dll'}


_LOCK = threading.RLock()


@contextmanager
def drjit_lock() -> Iterator[None]:
    """Lock Dr.Jit for this thread: recorded kernels serve one thread, and two threads in Dr.Jit may wait for each other for ever.

    It also tells Dr.Jit of a thread that goes on with the arrays of another one: on a GPU, PyTorch goes back through a graph in
    its own thread. It is also a decorator: `@drjit_lock()`.
    """
    import drjit as dr

    with _LOCK:
        for backend in dr.JitBackend.CUDA, dr.JitBackend.LLVM:
            if dr.has_backend(backend):
                dr.detail.new_scope(backend)
        yield


def cores() -> int:
    """The processor's cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1


def use_threads(number: int) -> None:
    """Set the number of threads in which Dr.Jit runs its kernels on the CPU.

    `dr.set_thread_count` alone crashes the process while a kernel runs that adds to a copy of its result for every thread.
    """
    import drjit as dr

    dr.sync_thread()
    dr.set_thread_count(number)


def find_libllvm() -> str | None:
    """Point DRJIT_LIBLLVM_PATH at the newest LLVM that the environment carries, unless the user has set it.

    It goes before the system's, which may be too old for Dr.Jit. Returns the path in use, or None if only Dr.Jit's own search
    of the system is left.
    """
    if os.environ.get('DRJIT_LIBLLVM_PATH'):
        return os.environ['DRJIT_LIBLLVM_PATH']
    packages = [Path(p) for p in sys.path if p.endswith('site-packages')]
    # The environment is three folders above site-packages, if there are so many.
    roots = dict.fromkeys((sys.prefix, *(str(above) for p in packages for above in p.parents[2:3])))
    carried = ([os.path.join(root, pattern) for pattern in _IN_ENVIRONMENT.get(sys.platform, _LINUX)] for root in roots)
    for places in *carried, [_INSTALLED.get(sys.platform, '')]:
        libraries = [path for place in places for path in glob.glob(place) if _numbers(path)[:1] >= [OLDEST_LLVM]]
        if libraries:
            os.environ['DRJIT_LIBLLVM_PATH'] = max(libraries, key=_numbers)
            return os.environ['DRJIT_LIBLLVM_PATH']
    return None


def _numbers(path: str) -> list[int]:
    """The version in the name of a library; if there is none, the oldest that works."""
    return [int(number) for number in re.findall(r'\d+', os.path.basename(path))] or [OLDEST_LLVM]


_POLICY = 'OMP_WAIT_POLICY'


def calm_openmp() -> None:
    """Let the threads of OpenMP sleep between two pieces of work, unless the user has chosen or PyTorch is loaded already.

    PyTorch's spin by default, and take the cores from Dr.Jit's: calls of both in turn took four times the CPU's time. OpenMP
    reads the environment once, when it is loaded.
    """
    if 'torch' not in sys.modules:
        os.environ.setdefault(_POLICY, 'passive')


@cache
def warn_of_spinning() -> None:
    """Warn, once, if PyTorch was loaded before `calm_openmp` could help."""
    if _POLICY not in os.environ:
        warnings.warn(
            "PyTorch's threads spin while Dr.Jit works, and slow it down: import lingo_mi before torch, or set the environment "
            f'variable {_POLICY}=passive',
            stacklevel=2,
        )


def restart_llvm() -> None:
    """Restart Dr.Jit on the bundled LLVM if it was imported before us and took an LLVM that cannot work.

    Dr.Jit loads LLVM as soon as it is imported, so that `import mitsuba` before `import lingo_mi` meets a system LLVM first.
    Restarting would lose the user's arrays: with any alive, a warning says what to do instead. (Mitsuba's own constants, the
    tables of colour matching functions, survive it.)
    """
    if 'drjit' not in sys.modules:
        return
    import drjit as dr

    path = os.environ.get('DRJIT_LIBLLVM_PATH')
    if dr.detail.llvm_version()[0] >= OLDEST_LLVM or not path:
        return
    core = next(Path(dr.__file__).parent.glob('libdrjit-core.*'), None)  # Windows has another name, and other symbols
    library = core and ctypes.CDLL(str(core))
    alive = True
    if library and all(hasattr(library, name) for name in (_SHUTDOWN, _INIT, _WHOS)):
        whos = library[_WHOS]
        whos.restype = ctypes.c_char_p
        rows = re.findall(rb'^ +\d+ +LLVM +\w+ .*? (\d+)(?: +\d+ K?i?B)? *$', whos(), re.MULTILINE)
        alive = any(int(size) not in (1, _COLOUR_SAMPLES) for size in rows)
    if not library or alive:
        warnings.warn(
            f'Dr.Jit runs on LLVM {dr.detail.llvm_version()[0]}, which cannot compile its kernels: '
            'import lingo_mi before mi.set_variant, or set DRJIT_LIBLLVM_PATH',
            stacklevel=3,
        )
        return
    library[_SHUTDOWN](0)
    library[_INIT](1 << 1 | 1 << 2)  # CUDA and LLVM


_COLOUR_SAMPLES = 95  # entries of Mitsuba's tables of colour matching functions

# jit_shutdown(int), jit_init(uint32_t) and jit_var_whos() of drjit-core, which Python does not bind
_SHUTDOWN, _INIT, _WHOS = '_Z12jit_shutdowni', '_Z8jit_initj', '_Z12jit_var_whosv'


def use_variant(name: str | None = None) -> str:
    """Activate a Mitsuba variant.

    Parameters
    ----------
    name : str, optional
        Name of the variant (default: cuda_ad_mono, or llvm_ad_mono if CUDA cannot run).

    Returns
    -------
    str
        Name of the active variant.

    Raises
    ------
    InputError
        For an unknown name, and if no variant can run. The message says what to install.

    Examples
    --------
    `lm.use_variant('llvm_ad_mono')`
    """
    import mitsuba as mi

    usable = [v for v in mi.variants() if v.endswith(('_ad_mono', '_ad_rgb'))]
    if name is not None and name not in usable:
        raise InputError(f'variant {name!r} is not one of {", ".join(usable)}')
    mi.set_log_level(mi.LogLevel.Error)  # its warnings are about films and files that a scan does not depend on
    library = os.environ.get('DRJIT_LIBLLVM_PATH', '')
    for variant in [name] if name else ['cuda_ad_mono', 'llvm_ad_mono']:
        if variant.startswith('llvm') and os.sep in library and not os.path.exists(library):
            raise InputError(f'DRJIT_LIBLLVM_PATH = {library}: there is no such file. {LLVM_HELP}')
        try:
            mi.set_variant(variant)
            import drjit as dr

            dr.eval(mi.Float(0) + dr.opaque(mi.Float, 1))  # an unusable backend fails at the first kernel
            return variant
        except (ImportError, RuntimeError) as error:  # what Mitsuba raises for a missing driver or library
            reason = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
    if variant.startswith('cuda'):
        raise InputError(f'variant {name}: no NVIDIA GPU can be used; take llvm_ad_mono to run on the CPU')
    raise InputError(f'no usable backend ({reason}). {LLVM_HELP}')


def ensure_variant(device: str | None = None) -> str:
    """The name of the active Mitsuba variant, with derivatives; chooses one (`use_variant`) if none is active yet.

    Parameters
    ----------
    device : str or None
        'cpu' or 'cuda', where the caller's arrays lie; None: anywhere.

    Raises
    ------
    InputError
        If no such variant can run, or if the active one works on another device.
    """
    import mitsuba as mi

    active = mi.variant()
    if active is None or '_ad_' not in active:
        return use_variant({None: None, 'cpu': 'llvm_ad_mono', 'cuda': 'cuda_ad_mono'}[device])
    where = 'cuda' if active.startswith('cuda') else 'cpu'
    if device not in (None, where):
        raise InputError(
            f'the arrays are on the device {device!r}, but the variant {active} works on {where!r}: move the arrays there, or '
            f'call mitsuba.set_variant({"cuda_ad_mono" if device == "cuda" else "llvm_ad_mono"!r}) first'
        )
    return active
