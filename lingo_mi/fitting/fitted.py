"""The result of a fit, from `loop.run` or from a checkpoint: a cloud, or a neural field, to be rendered and voxelized."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import one_at_a_time
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting import average, checkpoint, stopping
from lingo_mi.fitting.checkpoint_schema import geometry_of, settings_of
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.kinds import Model, model_of
from lingo_mi.fitting.poses import Poses
from lingo_mi.fitting.settings import Settings
from lingo_mi.fitting.state import State, activate
from lingo_mi.geometry.base import Geometry
from lingo_mi.metrics.quality import current_names
from lingo_mi.projectors.objects import Ellipsoids


class NeedsEffects(InputError):
    """A checkpoint cannot be read without the effects that its fit has modelled."""


@dataclass
class Fitted:
    """A fitted cloud, or a fitted neural field.

    model       forward model of the fit: settings as used, geometry of the scan as given, unit of density, modelled effects
    state       the final state (host)
    initial     centres the fit started from, float32 [N, 3], normalised frame; of a neural field none
    poses       corrections of the views; None if the fit has not corrected them
    seed        of the fit
    history     measurements over time: iteration, seconds, loss, gaussians, and the results of the fit's `measure`
    seconds     spent in steps, including those before an interruption
    info        data on the initial cloud (`InitialCloud.info`)
    search      what views that were held out said (`stopping.Search.record`); None without a search for the step to stop at
    steps       that were done: of an unfinished fit, and of one that has stopped early, fewer than the settings' iterations

    Example:

        fitted = run(scan, settings, initial_cloud(scan, settings))
        fitted.volume()                                   # on the scan's own grid
        fitted.render(scan.geometry.subset([0]))          # as the scan's detector would see it
        Fitted.from_checkpoint('out/foot/checkpoint.npz').volume()
    """

    model: Model
    state: State
    initial: np.ndarray
    poses: Poses | None = None
    seed: int = 0
    history: list[dict] = field(default_factory=list)
    seconds: float = 0.0
    info: dict = field(default_factory=dict)
    search: dict | None = None
    steps: int = 0

    @property
    def settings(self) -> Settings:
        """Settings as used, with the bounds that the scan sets."""
        return self.model.settings

    @property
    def geometry(self) -> Geometry:
        """Geometry of the scan, as given."""
        return self.model.geometry

    @property
    def unit(self) -> float:
        """The density, in 1/mm, that the fit counts as 1."""
        return self.model.unit

    @property
    def effects(self) -> Effects | None:
        """Effects of the scan that the fit has modelled; None if it treated the projections as line integrals."""
        return self.model.effects

    @property
    def corrected(self) -> Geometry:
        """The geometry with corrected poses; `geometry` itself if the fit has not corrected them."""
        return self.geometry if self.poses is None else self.poses.corrected(self.geometry)

    @one_at_a_time()
    def render(self, geometry: Geometry, progress: Callable[[int, int], None] | None = None) -> np.ndarray:
        """Projections in the views of a geometry, float32 [view, v, u]; see `CloudModel.render`."""
        return self.model.render(DeviceState(self.state), geometry, progress)

    @one_at_a_time()
    def expected(self, geometry: Geometry) -> np.ndarray:
        """What the scan's detector is expected to measure in views that were taken among those of the scan, float32 [view, v, u].

        That is `render`, but with the response and with smooth corrections of the poses that the fit has found, in the views for
        their time.
        """
        if self.poses is not None:
            geometry = self.poses.between(self.geometry, geometry)
        return self.model.expected(DeviceState(self.state), geometry)

    @one_at_a_time()
    def volume(self, geometry: Geometry | None = None) -> np.ndarray | None:
        """Density in 1/mm on a geometry's grid (default: the scan's), float32 [x, y, z]; None for alpha compositing."""
        return self.model.volume(DeviceState(self.state), geometry)

    @one_at_a_time()
    def cloud(self) -> Ellipsoids | None:
        """The Gaussians in mm, densities in 1/mm; None for alpha compositing and for a neural field."""
        return self.model.cloud(DeviceState(self.state))

    @one_at_a_time()
    def shares(self) -> np.ndarray | None:
        """The second material's share in every Gaussian's density, float32 [N]; None for one material."""
        share = self.model.shares(DeviceState(self.state))
        return None if share is None else share.numpy()

    def world_gaussians(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Centres and standard deviations in mm, quaternions (x, y, z, w), and densities in 1/mm (alpha compositing:
        opacities): float64 [N, 3], [N, 3], [N, 4], [N]. Raises InputError for a neural field."""
        if not self.settings.cloud:
            raise InputError('a neural field has no Gaussians: take its volume or its views')
        centre, scale, rotation, amount = activate(self.state, self.settings)
        size, unit = self.geometry.scale, self.unit if self.settings.volumetric else 1
        return centre / size + self.geometry.offOrigin, scale / size, rotation, amount * unit

    @classmethod
    def from_checkpoint(cls, path: Path | str, effects: Effects | None = None) -> Fitted:
        """The fit stored in a checkpoint.npz, finished or not. Needs no scan.

        effects   of the scan, if the fit has modelled them; a checkpoint does not store them

        Raises InputError if the file is missing or not a checkpoint, or if the fit has modelled effects that are not given.
        """
        state, extra, arrays = checkpoint.load(path)
        if 'unit' not in extra:
            raise InputError(f'{path}: is no checkpoint of a fit by this version of lingo_mi; fit again')
        settings, geometry = settings_of(extra), geometry_of(extra)
        try:
            search = stopping.stored(arrays)
        except InputError as error:
            raise InputError(f'{path}: {error}') from None
        if effects is None and extra.get('effects', bool(arrays.keys() & {'share', 'scattered'})):
            raise NeedsEffects(
                f'{path}: the fit has modelled effects of its scan, which a checkpoint does not keep: load the folder of its '
                'result, whose result.xml has them'
            )
        poses = None
        if max(settings.adam.rate_pose) > 0:
            poses = Poses(len(geometry), smooth=settings.calibration.pose_motion == 'smooth')
            poses.restore(arrays)
        state.values |= average.values_of(arrays)
        model = model_of(settings, geometry, extra['unit'], effects)
        if model.response is not None:
            model.response.restore(arrays)
        history = [current_names(entry) for entry in extra['history']]
        seed, seconds, info = (extra[name] for name in ('seed', 'seconds', 'info'))
        steps = extra['iteration']
        return cls(model, state, arrays['initial'], poses, seed, history, seconds, info, search, steps)
