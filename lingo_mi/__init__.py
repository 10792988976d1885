"""Sparse-view X-ray CT with 3D Gaussians: exact line integrals in Mitsuba 3 / Dr.Jit.

    import lingo_mi as lm

    data = lm.simulate('x3d_foot', views=25)            # or lm.load('scan.pickle')
    fit = lm.fit(data, lm.Fast())                       # half a minute; or lm.LINGO(), lm.R2(), ...
    fit.volume()                                        # [x, y, z], density per mm
    fit.render(data.test.geometry)                      # [view, v, u], line integrals
    lm.reconstruct(data.train, lm.SART(niter=20), start=fit)
    images = lm.project(fit.gaussians, data.test.geometry)    # or four arrays of NumPy, Dr.Jit, PyTorch, JAX

Each name is loaded on first use. If no variant of Mitsuba is active then, one is chosen. `import lingo_mi` and
`mitsuba.set_variant(...)`, in either order, make the plugins known to Mitsuba.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from lingo_mi.common.runtime import calm_openmp, find_libllvm, restart_llvm

calm_openmp()  # before anything loads PyTorch
find_libllvm()  # before anything loads Dr.Jit
restart_llvm()  # or anew, if something has loaded it

from lingo_mi.plugins import watch_variants  # noqa: E402 - loads Mitsuba, and Dr.Jit with it

watch_variants()

__version__ = '0.2.0.dev0'

if TYPE_CHECKING:  # editors read these in place of the table below
    from lingo_mi.api.calibration import calibrate
    from lingo_mi.api.data import load, load_raw, phantom, simulate
    from lingo_mi.api.estimate import Estimate, estimate
    from lingo_mi.api.fitting import fit
    from lingo_mi.api.volumes import reconstruct
    from lingo_mi.calibration.calibration import Calibration
    from lingo_mi.common.errors import InputError
    from lingo_mi.common.runtime import use_variant
    from lingo_mi.fitting.field.options import Field
    from lingo_mi.fitting.fit import Fit, load_fit
    from lingo_mi.fitting.method import Method
    from lingo_mi.fitting.methods.densities import DensityMethod
    from lingo_mi.fitting.methods.fast import Fast
    from lingo_mi.fitting.methods.lingo import LINGO
    from lingo_mi.fitting.methods.naf import NAF
    from lingo_mi.fitting.methods.r2 import R2
    from lingo_mi.fitting.methods.splatting import GaussianSplatting, XGaussian
    from lingo_mi.fitting.options.bounds import ScaleBounds
    from lingo_mi.fitting.options.corrections import Corrections
    from lingo_mi.fitting.options.densification import Clone, CloneOpacities, Halve
    from lingo_mi.fitting.options.loss import ImageLoss, Loss
    from lingo_mi.fitting.options.rates import DensityRates, FieldRates, OpacityRates
    from lingo_mi.fitting.options.stopping import Stopping
    from lingo_mi.fitting.start.edges import EdgeStart
    from lingo_mi.fitting.start.fdk import FDKStart
    from lingo_mi.fitting.start.masks import MaskStart
    from lingo_mi.fitting.start.start import Start, StartingCloud
    from lingo_mi.fitting.start.uniform import CuboidStart, RandomStart
    from lingo_mi.functional import GaussianProjector, Projector, project, voxelize
    from lingo_mi.functional.gaussians import Gaussians
    from lingo_mi.geometry import Geometry, Grid, circular
    from lingo_mi.reconstruction import (
        ASDPOCS,
        CGLS,
        FDK,
        OSSART,
        SART,
        SIRT,
        Best,
        PenalisedLeastSquares,
        Reconstruction,
        Refined,
    )
    from lingo_mi.reconstruction.priors import (
        TGV,
        TV,
        Denoiser,
        DirectionalTV,
        Huber,
        NonLocalMeans,
        Prior,
        PriorSum,
        Wavelets,
    )
    from lingo_mi.scan import Dataset, Scan

# Module -> the public names that it defines, in the order of their use.
_MODULES = {
    'api.data': 'simulate load load_raw phantom',
    'api.calibration': 'calibrate',
    'calibration.calibration': 'Calibration',
    'geometry': 'Geometry Grid circular',
    'scan': 'Scan Dataset',
    'api.fitting': 'fit',
    'fitting.methods.lingo': 'LINGO',
    'fitting.methods.fast': 'Fast',
    'fitting.methods.r2': 'R2',
    'fitting.methods.splatting': 'GaussianSplatting XGaussian',
    'fitting.methods.naf': 'NAF',
    'fitting.methods.densities': 'DensityMethod',
    'fitting.method': 'Method',
    'fitting.start.start': 'Start StartingCloud',
    'fitting.start.masks': 'MaskStart',
    'fitting.start.edges': 'EdgeStart',
    'fitting.start.fdk': 'FDKStart',
    'fitting.start.uniform': 'RandomStart CuboidStart',
    'fitting.options.loss': 'Loss ImageLoss',
    'fitting.options.rates': 'DensityRates OpacityRates FieldRates',
    'fitting.options.densification': 'Clone Halve CloneOpacities',
    'fitting.options.corrections': 'Corrections',
    'fitting.options.stopping': 'Stopping',
    'fitting.options.bounds': 'ScaleBounds',
    'fitting.field.options': 'Field',
    'fitting.fit': 'Fit load_fit',
    'api.volumes': 'reconstruct',
    'api.estimate': 'estimate Estimate',
    'reconstruction': 'Reconstruction FDK SART OSSART SIRT CGLS ASDPOCS PenalisedLeastSquares Refined Best',
    'reconstruction.priors': 'TV DirectionalTV TGV Huber Wavelets NonLocalMeans Denoiser PriorSum Prior',
    'functional': 'Projector GaussianProjector project voxelize',
    'functional.gaussians': 'Gaussians',
    'common.runtime': 'use_variant',
    'common.errors': 'InputError',
}
_PUBLIC = {name: f'lingo_mi.{module}' for module, names in _MODULES.items() for name in names.split()}
__all__ = list(_PUBLIC)


def __getattr__(name: str):
    if name not in _PUBLIC:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
