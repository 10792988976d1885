"""Backend choice: find libLLVM before Dr.Jit loads, choose a variant, register the plugins."""
from __future__ import annotations

import glob
import os
import sys
import warnings
from pathlib import Path

LLVM_HELP = ('Dr.Jit needs LLVM 17 or newer on the CPU. On Linux x86-64 `pip install karellen-llvm-core` brings one; '
             'elsewhere install LLVM and set DRJIT_LIBLLVM_PATH to its libLLVM shared library.')


def find_libllvm() -> str | None:
    """Point DRJIT_LIBLLVM_PATH at the libLLVM that the environment carries, unless the user has set it.

    The bundled library goes before a system one because Dr.Jit 1.5 refuses LLVM 14, and 15 and 16 abort the process
    on ordinary kernels. Returns the path in use, or None where only a system search is left.
    """
    if os.environ.get('DRJIT_LIBLLVM_PATH'):
        return os.environ['DRJIT_LIBLLVM_PATH']
    for root in dict.fromkeys((sys.prefix, *(str(Path(p).parents[2]) for p in sys.path if p.endswith('site-packages')))):
        found = sorted(glob.glob(os.path.join(root, 'lib', 'libLLVM.so*')) + glob.glob(os.path.join(root, 'lib', 'libLLVM-*.so')))
        if found:
            os.environ['DRJIT_LIBLLVM_PATH'] = found[0]
            return found[0]
    return None


def use_variant(name: str | None = None) -> str:
    """Activate a Mitsuba variant and return its name: `name`, else cuda_ad_mono, else llvm_ad_mono.

    Raises InputError where none can run, saying what to install.
    """
    import mitsuba as mi

    from .errors import InputError

    if name is not None and name not in mi.variants():
        raise InputError(f'--variant {name}: not one of {", ".join(mi.variants())}')
    for variant in [name] if name else ['cuda_ad_mono', 'llvm_ad_mono']:
        try:
            mi.set_variant(variant)
            import drjit as dr
            dr.eval(mi.Float(0) + dr.opaque(mi.Float, 1))  # an unusable backend fails at the first kernel
            return variant
        except Exception as error:  # Dr.Jit raises plain RuntimeErrors for a missing driver or library
            reason = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
    raise InputError(f'no usable backend ({reason}). {LLVM_HELP}')


def watch_variants():
    """Register the plugins with the active variant, and again with whichever is set later."""
    import mitsuba as mi

    def register(*_):
        if 'ad' in mi.variant().split('_'):
            from . import plugins
            plugins.register()
    mi.detail.add_variant_callback(register)
    if mi.variant() is not None:
        register()
