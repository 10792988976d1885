"""NAF: a neural attenuation field, the baseline that is not made of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import Self

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import room
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.field.field_model import FieldModel
from lingo_mi.fitting.field.field_step import FieldStepper
from lingo_mi.fitting.field.network import Network
from lingo_mi.fitting.field.options import Field
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.options.rates import FieldRates
from lingo_mi.geometry.base import Geometry
from lingo_mi.scan import Scan

BYTES = 32  # for each parameter of a field: its moments, its derivatives and copies of these


@dataclass(frozen=True)
class NAF(Method):
    """NAF with its released settings of the chest: 1500 passes over 50 views, and the mean squared error of single rays.

    Rates here fall to a tenth log-linearly. They step down to it in the paper, and stay constant in the released ones. Rays are
    sampled within the volume alone, but in NAF between two distances that are the same for all rays and reach beyond the
    volume. NAF's lengths are metres, and its epsilon of Adam is 1e-8. In the normalised frame of a volume of 256 mm, gradients
    are (1000 * 2 / 256)^2 = 61 times as large, and so is epsilon. The unit of density and the start differ, too.

    Parameters
    ----------
    iterations, batch, view_order, checkpoint_seconds, stopping
        See `Method`.
    rates : FieldRates
        Adam's step sizes.
    field : Field
        Hash grid, network and samples.
    normalise : bool
        Whether the unit of density is a bound of the densities (see `field.densities`); NAF expects volumes in [0, 1] instead.

    References
    ----------
    Zha, Zhang and Li, "NAF: Neural Attenuation Fields for Sparse-View CBCT Reconstruction", MICCAI 2022.

    Examples
    --------
    `lm.fit(scan, lm.NAF(iterations=20_000)).volume()`
    """

    name: ClassVar = 'naf'
    makes_gaussians: ClassVar = False

    iterations: int = 75_000
    rates: FieldRates = FieldRates(decay_steps=0, epsilon=6e-7)
    field: Field = Field()
    normalise: bool = True

    def shapes(self, count: int) -> dict[str, tuple[int, int]]:
        return Network(self.field).shapes

    def bounded(self, scan: Scan) -> Self:
        """See `Method.bounded`; raises InputError for a field that is larger than memory, too."""
        needed = BYTES * sum(n for n, _ in self.shapes(0).values())
        if needed > (has := room()):
            raise InputError(
                f'the field needs at least {needed / 2**30:,.1f} GiB of memory, but this process may take '
                f'{has / 2**30:,.1f} GiB: lower field_entries'
            )
        return super().bounded(scan)

    def model(self, geometry: Geometry, unit: float, effects: Effects | None = None) -> FieldModel:
        return FieldModel(self.field, geometry, unit)

    def stepper(self, scan: Scan) -> FieldStepper:
        return FieldStepper(self, self.field, self.normalise, scan)
