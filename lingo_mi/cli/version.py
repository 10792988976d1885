"""The text of `lingo-mi --version`: the versions of all software that a result depends on, for a bug report."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from lingo_mi.common.gpu import gpu
from lingo_mi.common.runtime import find_libllvm

PACKAGES = 'lingo_mi', 'mitsuba', 'drjit', 'numpy', 'scipy', 'scikit-image'


def report() -> str:
    """The versions, a line each."""
    lines = {name: _installed(name) for name in PACKAGES}
    lines |= {'Python': platform.python_version(), 'platform': platform.platform()}
    lines |= {'LLVM': _llvm(), 'GPU': _gpu(), 'variants': _variants()}
    width = max(map(len, lines))
    return '\n'.join(f'{name:{width}s}  {value}' for name, value in lines.items())


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return 'not installed'


def _llvm() -> str:
    """The version of LLVM that Dr.Jit has loaded, and the library's path if it is known."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        return 'not found'
    return f'{".".join(map(str, dr.detail.llvm_version()))}, {find_libllvm() or "of the system"}'


def _gpu() -> str:
    try:
        return gpu().name
    except OSError:
        return 'none'


def _variants() -> str:
    import mitsuba as mi

    return ', '.join(mi.variants())
