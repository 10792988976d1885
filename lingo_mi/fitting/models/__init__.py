"""Forward models: the raw parameters of a Gaussian, and how Gaussians become the image of a view."""

from __future__ import annotations

from lingo_mi.fitting.models.alpha import AlphaCompositing
from lingo_mi.fitting.models.base import ForwardModel
from lingo_mi.fitting.models.integral import LineIntegrals
from lingo_mi.fitting.settings import Settings


def forward_model(settings: Settings) -> ForwardModel:
    """The forward model for the setting `render`."""
    return {'integral': LineIntegrals, 'alpha': AlphaCompositing}[settings.model.render](settings)
