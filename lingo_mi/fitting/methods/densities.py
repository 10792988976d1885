"""Methods of Gaussians with densities, whose line integrals are compared with the projections."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from typing_extensions import Self

from lingo_mi.calibration.response.response import Response
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.corrections.correction import Correction
from lingo_mi.fitting.corrections.light import Light
from lingo_mi.fitting.corrections.materials import Materials
from lingo_mi.fitting.corrections.poses import PoseCorrection, Poses
from lingo_mi.fitting.corrections.response import ResponseCorrection
from lingo_mi.fitting.measured import density_unit, modelled_effects
from lingo_mi.fitting.methods.cloud_method import CloudMethod
from lingo_mi.fitting.models.density import DensityModel
from lingo_mi.fitting.models.integral import LineIntegrals
from lingo_mi.fitting.options.corrections import Corrections
from lingo_mi.fitting.options.densification import CloneOpacities
from lingo_mi.fitting.options.loss import Loss
from lingo_mi.fitting.options.part import require
from lingo_mi.fitting.options.rates import DensityRates
from lingo_mi.fitting.step import GaussianStepper
from lingo_mi.geometry.base import Geometry
from lingo_mi.scan import Scan


@dataclass(frozen=True)
class DensityMethod(CloudMethod):
    """A method of Gaussians with densities. The defaults are R2-Gaussian's published values.

    Parameters
    ----------
    iterations, batch, view_order, checkpoint_seconds, stopping
        See `Method`.
    rates : DensityRates
        Adam's step sizes.
    start, densify, bounds, normalise, extent
        See `CloudMethod`.
    loss : Loss
        Comparison with the measured views, and total variation of the volume.
    corrections : Corrections
        Errors of the measurement that are fitted together with the cloud.
    effects : {'model', 'ignore'}
        Whether the fit models the effects that the scene declares (spectrum, focal spot, blur, dead pixels), or takes all
        projections for line integrals.

    Examples
    --------
    `lm.fit(scan, lm.DensityMethod(start=lm.EdgeStart(), densify=lm.Halve()))`
    """

    CHOICES: ClassVar = CloudMethod.CHOICES | dict(effects=('model', 'ignore'))

    rates: DensityRates = DensityRates()
    loss: Loss = Loss()
    corrections: Corrections = Corrections()
    effects: str = 'model'  # type: ignore[assignment] - a constant of methods that model none

    def __post_init__(self):
        super().__post_init__()
        require(self.start.densities, f'start={self.start.name} makes no densities: take edges, masks or fdk')
        require(
            not isinstance(self.densify, CloneOpacities),
            'densify=opacities is for Gaussians with opacities: take clone or halve',
        )

    @property
    def forward(self) -> LineIntegrals:
        return LineIntegrals(self.bounds, self.extent)

    @property
    def frees_views(self) -> bool:
        return self.corrections.moves_views and self.corrections.pose_motion == 'view'

    @property
    def extensible(self) -> bool:
        return super().extensible and not self.corrections.responds

    def bounded(self, scan: Scan) -> Self:
        """See `CloudMethod.bounded`; `tv_views` limits the total variation, too."""
        method = super().bounded(scan)
        return replace(method, loss=self.loss.limited(len(scan)))

    def model(self, geometry: Geometry, unit: float, effects: Effects | None = None) -> DensityModel:
        corrections = self.corrections
        response = Response.of(
            geometry, air=corrections.fit_air, gain=corrections.fit_gain, pixels=corrections.fit_pixels
        )
        return DensityModel(self.forward, geometry, unit, effects, response, self.extent)

    def poses(self, geometry: Geometry) -> Poses | None:
        if not self.corrections.moves_views:
            return None
        flat = geometry.grid.shape[2] == 1  # a fan beam does not determine the direction across its plane
        return Poses(len(geometry), flat, self.corrections.pose_motion == 'smooth')

    def stepper(self, scan: Scan) -> GaussianStepper:
        unit = density_unit(scan, self.normalise)
        model = self.model(scan.geometry, unit, modelled_effects(scan, self.effects))
        poses = self.poses(scan.geometry)
        corrections: list[Correction] = []
        if model.signal is not None and model.signal.split is not None:
            corrections.append(Materials())
        if model.signal is not None and model.signal.scattered is not None:
            corrections.append(Light())
        if model.response is not None:
            corrections.append(ResponseCorrection(model.response, scan, self.effects, self.loss.weights))
        if poses is not None:
            corrections.append(PoseCorrection(poses, self.corrections.rate_pose))
        return GaussianStepper(self, scan, model, corrections)
