"""Fitted clouds, and fields, loaded from a fit's files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lingo_mi.calibration.response.response import Response
from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import Effects, find_effects
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.poses import Poses
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.objects import Ellipsoids, find_objects
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import render_objects
from lingo_mi.storage.file_access import parsed_json
from lingo_mi.storage.output_folder import CLOUD, METRICS, require_together

WANTED = 'give the result.xml of a fit, or the checkpoint.npz of one by naf, 3dgs or xgaussian'


@dataclass(frozen=True)
class FittedCloud:
    """A cloud of Gaussians as stored in the scene of a fit (result.xml).

    gaussians   densities in 1/mm
    geometry    of the scan that it was fitted to
    corrected   the geometry with corrected poses; `geometry` itself if the fit has not corrected them
    extent      cut-off in standard deviations
    effects     effects that the fit has modelled; None if it treated the projections as line integrals
    response    air levels and gains of the views that the fit has found; None if it sought none
    seed        of the fit and of the noise in its simulated scan; None if unknown
    """

    gaussians: Ellipsoids
    geometry: Geometry
    corrected: Geometry
    extent: float
    effects: Effects | None
    response: Response | None
    seed: int | None

    @classmethod
    def of(cls, fitted: Fitted) -> FittedCloud | Fitted:
        """The cloud of a fit. For alpha compositing, whose Gaussians have no densities, and for a neural field the fit itself."""
        gaussians = fitted.cloud()
        if gaussians is None:
            return fitted
        extent = fitted.settings.model.extent
        effects = fitted.effects and fitted.effects.of_cloud()
        return cls(gaussians, fitted.geometry, fitted.corrected, extent, effects, fitted.model.response, fitted.seed)

    def render(self, geometry: Geometry) -> np.ndarray:
        """Line integrals in any views, float32 [view, v, u]."""
        return render_objects([self.gaussians], geometry, self.extent)


def load_cloud(path: Path | str) -> FittedCloud | Fitted:
    """The cloud of a scene such as a fit's result.xml, or from its checkpoint (.npz) a fit by alpha compositing or of a field.

    Both have `geometry`, `corrected`, `effects`, `seed` and `render`. Raises InputError for any other file, and for one of a
    result whose files do not belong together.
    """
    require_together(Path(path).parent, [Path(path).name, CLOUD])
    if Path(path).suffix == '.npz':
        return _from_checkpoint(path)
    loaded = load_scene(Path(path))
    objects = find_objects(loaded.scene)
    options = getattr(loaded.scene.integrator(), 'options', None)
    if options is None or len(objects) != 1 or not isinstance(objects[0], Ellipsoids):
        raise InputError(f'{path}: is no cloud of Gaussians; {WANTED}')
    corrected, record = loaded.scanner.geometry, _record(path)
    given = _as_given(corrected, record, path)
    return FittedCloud(
        objects[0],
        given,
        corrected,
        options.extent,
        find_effects(loaded.scene, loaded.scanner),
        _response(given, record, path),
        record.get('seed'),
    )


def _record(path) -> dict:
    """The metrics file of a fit, next to its result.xml; empty if there is none."""
    file = Path(path).with_name(METRICS)
    if not file.exists():
        return {}
    try:
        record = parsed_json(file.read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise InputError(f'{file}: cannot be read ({type(error).__name__}); fit again, or remove it') from None
    return record if isinstance(record, dict) else {}


def _as_given(geometry: Geometry, record: dict, path) -> Geometry:
    """The fit's given geometry, from the corrected one in its result.xml."""
    if 'pose_turns_degrees' not in record:
        return geometry
    poses = Poses(len(geometry))
    try:
        turn, shift = (np.array(record[name], float) for name in ('pose_turns_degrees', 'pose_shifts_mm'))
    except (KeyError, TypeError, ValueError):
        turn = shift = np.empty(0)
    if turn.shape != poses.turn.shape or shift.shape != poses.shift.shape:
        raise InputError(f'{path}: the poses in the {METRICS} beside it are of another fit')
    poses.turn, poses.shift = np.radians(turn), shift * geometry.scale
    return poses.undone().corrected(geometry)


def _response(geometry: Geometry, record: dict, path) -> Response | None:
    """The air levels and gains of the views that a fit has found."""
    if 'response' not in record:
        return None
    try:
        found = {name: np.array(values, float)[:, None] for name, values in record['response'].items()}
        if any(x.shape != (len(geometry), 1) for x in found.values()):
            raise ValueError
    except (AttributeError, IndexError, TypeError, ValueError):
        raise InputError(f'{path}: the response in the {METRICS} beside it is of another fit') from None
    air, gain = ('view' if name in found else 'off' for name in ('air_level', 'gain_percent'))
    response = Response.of(geometry, air=air, gain=gain)
    for part in response.parts if response else ():
        part.values = found['air_level'] if part.name == 'air' else found['gain_percent'] / 100
    return response


def _from_checkpoint(path) -> Fitted:
    if not Path(path).exists():
        raise InputError(f'{path}: no such file; {WANTED}')
    fitted = Fitted.from_checkpoint(path)
    if fitted.settings.volumetric and fitted.settings.cloud:
        raise InputError(f'{path}: is the checkpoint of a fit that has a result.xml; {WANTED}')
    return fitted
