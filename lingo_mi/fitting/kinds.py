"""What a fit can be of: Gaussians, or a neural field. The loop, results and completion know both by the same functions."""

from __future__ import annotations

from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.cloud_model import CloudModel
from lingo_mi.fitting.field.field_model import FieldModel
from lingo_mi.fitting.field.field_step import FieldStepper
from lingo_mi.fitting.settings import Settings
from lingo_mi.fitting.step import Stepper
from lingo_mi.geometry.base import Geometry
from lingo_mi.scan import Scan

Model = CloudModel | FieldModel


def stepper_of(scan: Scan, settings: Settings) -> Stepper | FieldStepper:
    """The optimisation that the setting `render` asks for. Raises InputError as its class does."""
    return (Stepper if settings.cloud else FieldStepper)(scan, settings)


def model_of(settings: Settings, geometry: Geometry, unit: float, effects: Effects | None = None) -> Model:
    """The forward model of a fit with these settings. Raises InputError for effects that it cannot model."""
    return CloudModel(settings, geometry, unit, effects) if settings.cloud else FieldModel(settings, geometry, unit)
