"""Sparse-view X-ray CT with 3D Gaussians: exact line integrals in Mitsuba 3 / Dr.Jit.

    import lingo_mi as lm

    data = lm.simulate('x3d_foot', views=25)            # or lm.load('scan.pickle')
    result = lm.fit(data, 'fast')
    result.volume()                                     # [x, y, z], density per mm
    result.render(data.test.geometry)                   # [view, v, u], line integrals
    lm.reconstruct(data.train, lm.SART(niter=20), start=result)
    images = lm.project(*result.gaussians, data.test.geometry)   # differentiable: NumPy, Dr.Jit, PyTorch, JAX

The names below are loaded on first use, and choose a variant of Mitsuba where none is active. `import lingo_mi` and
`mitsuba.set_variant(...)`, in either order, make the plugins known to Mitsuba.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from lingo_mi.common.runtime import find_libllvm, mend_llvm

find_libllvm()  # before anything loads Dr.Jit
mend_llvm()  # or after it

from lingo_mi.plugins import watch_variants  # noqa: E402 - loads Mitsuba, and Dr.Jit with it

watch_variants()

__version__ = '0.2.0.dev0'

__all__ = [  # noqa: RUF022 - in the order of their use
    'simulate',
    'load',
    'load_raw',
    'phantom',
    'calibrate',
    'Calibration',
    'Geometry',
    'circular',
    'Scan',
    'Dataset',
    'fit',
    'Settings',
    'Result',
    'Gaussians',
    'load_result',
    'reconstruct',
    'Reconstruction',
    'FDK',
    'SART',
    'OSSART',
    'SIRT',
    'CGLS',
    'ASDPOCS',
    'Refined',
    'Best',
    'project',
    'voxelize',
    'use_variant',
    'InputError',
]

if TYPE_CHECKING:
    from lingo_mi.api.calibration import Calibration, calibrate
    from lingo_mi.api.data import load, load_raw, phantom, simulate
    from lingo_mi.api.fitting import fit
    from lingo_mi.api.result import Gaussians, Result, load_result
    from lingo_mi.api.volumes import reconstruct
    from lingo_mi.common.errors import InputError
    from lingo_mi.common.runtime import use_variant
    from lingo_mi.fitting.settings import Settings
    from lingo_mi.functional import project, voxelize
    from lingo_mi.geometry import Geometry, circular
    from lingo_mi.reconstruction import ASDPOCS, CGLS, FDK, OSSART, SART, SIRT, Best, Reconstruction, Refined
    from lingo_mi.scan import Dataset, Scan

# Name -> the module that defines it.
_PUBLIC = {
    'simulate': 'lingo_mi.api.data',
    'load': 'lingo_mi.api.data',
    'load_raw': 'lingo_mi.api.data',
    'phantom': 'lingo_mi.api.data',
    'calibrate': 'lingo_mi.api.calibration',
    'Calibration': 'lingo_mi.api.calibration',
    'Geometry': 'lingo_mi.geometry',
    'circular': 'lingo_mi.geometry',
    'Scan': 'lingo_mi.scan',
    'Dataset': 'lingo_mi.scan',
    'fit': 'lingo_mi.api.fitting',
    'Settings': 'lingo_mi.fitting.settings',
    'Result': 'lingo_mi.api.result',
    'Gaussians': 'lingo_mi.api.result',
    'load_result': 'lingo_mi.api.result',
    'reconstruct': 'lingo_mi.api.volumes',
    'Reconstruction': 'lingo_mi.reconstruction',
    'FDK': 'lingo_mi.reconstruction',
    'SART': 'lingo_mi.reconstruction',
    'OSSART': 'lingo_mi.reconstruction',
    'SIRT': 'lingo_mi.reconstruction',
    'CGLS': 'lingo_mi.reconstruction',
    'ASDPOCS': 'lingo_mi.reconstruction',
    'Refined': 'lingo_mi.reconstruction',
    'Best': 'lingo_mi.reconstruction',
    'project': 'lingo_mi.functional',
    'voxelize': 'lingo_mi.functional',
    'use_variant': 'lingo_mi.common.runtime',
    'InputError': 'lingo_mi.common.errors',
}


def __getattr__(name: str):
    if name not in _PUBLIC:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
