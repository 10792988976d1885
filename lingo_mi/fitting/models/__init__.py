"""Forward models: the raw parameters of a Gaussian, and how Gaussians become the image of a view."""

from __future__ import annotations

from lingo_mi.fitting.field.network import Network
from lingo_mi.fitting.models.alpha import AlphaCompositing
from lingo_mi.fitting.models.base import ForwardModel
from lingo_mi.fitting.models.integral import LineIntegrals
from lingo_mi.fitting.settings import Settings


def forward_model(settings: Settings) -> ForwardModel:
    """The forward model of Gaussians for the setting `render`."""
    return {'integral': LineIntegrals, 'alpha': AlphaCompositing}[settings.model.render](settings)


def parameter_shapes(settings: Settings, count: int) -> dict[str, tuple[int, int]]:
    """Shapes of the raw parameters of a fit by name: of `count` Gaussians, or of a neural field."""
    if not settings.cloud:
        return Network(settings.neural).shapes
    return {name: (count, size) for name, size in forward_model(settings).parameters.items()}
