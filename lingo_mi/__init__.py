"""Sparse-view X-ray CT with 3D Gaussians: exact line integrals in Mitsuba 3 / Dr.Jit.

`import lingo_mi` and `mitsuba.set_variant(...)`, in either order, make the plugins known to Mitsuba. The geometry, image,
metric, file and phantom modules load without Mitsuba.
"""

from lingo_mi.runtime import find_libllvm, mend_llvm

find_libllvm()  # before anything loads Dr.Jit
mend_llvm()  # or after it

from lingo_mi.plugins import watch_variants  # noqa: E402 - loads Mitsuba, and Dr.Jit with it

watch_variants()

__version__ = '0.1.0'
