"""3D Gaussian Splatting and X-Gaussian: baselines that composite opacities to grey images, and make no volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import Self

from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.measured import density_unit
from lingo_mi.fitting.methods.cloud_method import CloudMethod
from lingo_mi.fitting.models.alpha import AlphaCompositing, scene_radius
from lingo_mi.fitting.models.cloud import CloudModel
from lingo_mi.fitting.options.bounds import ScaleBounds
from lingo_mi.fitting.options.densification import CloneOpacities
from lingo_mi.fitting.options.loss import Loss
from lingo_mi.fitting.options.part import MOST_STEPS, require
from lingo_mi.fitting.options.rates import OpacityRates
from lingo_mi.fitting.start.start import Start
from lingo_mi.fitting.start.uniform import CuboidStart, RandomStart
from lingo_mi.fitting.step import GaussianStepper
from lingo_mi.geometry.base import Geometry
from lingo_mi.scan import Scan


@dataclass(frozen=True)
class GaussianSplatting(CloudMethod):
    """3DGS on grey images, the projections divided by their maximum, with its released settings.

    Gaussians have opacities and radiances and are composited front to back. A fit makes views and no volume. The scales are
    unbounded in 3DGS; here bounds keep them where float32 and the footprints are valid.

    Parameters
    ----------
    iterations, batch, view_order, checkpoint_seconds, stopping
        See `Method`.
    rates : OpacityRates
        Adam's step sizes.
    start, loss, bounds, normalise, extent
        See `CloudMethod`.
    densify : CloneOpacities
        When Gaussians are added and removed, and how.
    sh_degree : int
        Degree of the radiance's spherical harmonics, at most 3 (3DGS: 3); 0: the same radiance in all directions.
    sh_every : int
        Iterations between the starts of successive degrees (3DGS: 1000).

    References
    ----------
    Kerbl, Kopanas, Leimkuehler and Drettakis, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", ACM TOG 42, 2023.

    Examples
    --------
    `lm.fit(scan, lm.GaussianSplatting(sh_degree=0))`
    """

    RANGES: ClassVar = CloudMethod.RANGES | dict(sh_degree=(0, 3), sh_every=(1, MOST_STEPS))
    name: ClassVar = '3dgs'
    makes_volume: ClassVar = False

    rates: OpacityRates = OpacityRates()
    start: Start = RandomStart()
    densify: CloneOpacities = CloneOpacities()
    bounds: ScaleBounds = ScaleBounds(scale_min=1e-5)
    normalise: bool = True
    extent: float = 3.33
    sh_degree: int = 3
    sh_every: int = 1000

    def __post_init__(self):
        super().__post_init__()
        require(
            isinstance(self.densify, CloneOpacities),
            f'densify={self.densify.name} is for Gaussians with densities: take opacities',
        )
        require(not isinstance(self.loss, Loss), 'loss has a total variation, which opacities do not: take ImageLoss')
        require(self.normalise, 'normalise must be true: grey images are the projections over their maximum')

    @property
    def forward(self) -> AlphaCompositing:
        return AlphaCompositing(self.bounds, self.sh_degree, self.sh_every)

    def with_lengths(self, geometry: Geometry) -> Self:
        """The method with `rate_centre`, `split_size` and `prune_size` converted from units of the scene's radius."""
        radius = scene_radius(geometry)
        return self.changed(
            rate_centre=tuple(radius * r for r in self.rates.rate_centre),
            split_size=radius * self.densify.split_size,
            prune_size=radius * self.densify.prune_size,
        )

    def model(self, geometry: Geometry, unit: float, effects: Effects | None = None) -> CloudModel:
        return CloudModel(self.forward, geometry, unit)

    def stepper(self, scan: Scan) -> GaussianStepper:
        return GaussianStepper(self, scan, self.model(scan.geometry, density_unit(scan, self.normalise)))


@dataclass(frozen=True)
class XGaussian(GaussianSplatting):
    """X-Gaussian: the same radiance in all directions, a regular grid for a start, the released settings of its foot scan.

    Its code divides every view by its own maximum. Here one maximum is taken for all, so that views stay comparable. The options
    are the same as for `GaussianSplatting`.

    References
    ----------
    Cai, Liang, Wang, Wang, Zhang, Yang, Zhou and Yuille, "Radiative Gaussian Splatting for Efficient X-ray Novel View Synthesis",
    ECCV 2024.

    Examples
    --------
    `lm.fit(scan, lm.XGaussian())`
    """

    name: ClassVar = 'xgaussian'

    iterations: int = 20_000
    rates: OpacityRates = OpacityRates(
        decay_steps=20_000, rate_centre=(1.79e-4, 1.79e-6), rate_radiance=(2e-3, 2e-3), rate_opacity=(6e-3, 6e-3)
    )
    start: Start = CuboidStart()
    densify: CloneOpacities = CloneOpacities(
        densify_until=8000,
        densify_every=800,
        densify_threshold=3.375e-5,  # 2.7e-5 for 3DGS's loss
        split_size=0.008,
        reset_every=1200,
    )
    sh_degree: int = 0
