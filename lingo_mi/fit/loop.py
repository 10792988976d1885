"""The loop of a fit: views in turn, densification, measurements on the way, checkpoints."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import drjit as dr
import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.fit import checkpoint
from lingo_mi.fit.average import Average
from lingo_mi.fit.densify import densify, reset_opacity
from lingo_mi.fit.device import DeviceState
from lingo_mi.fit.settings import Settings
from lingo_mi.fit.state import State, parameters, start
from lingo_mi.fit.step import Stepper
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.scan import Scan
from lingo_mi.scene.description import describe


@dataclass
class Fitted:
    """What a fit gives.

    state       the final state (host)
    stepper     renders and voxelizes it
    settings    as used
    initial     centres the fit started from [N, 3]
    history     a list of measurements over time: iteration, seconds, loss, gaussians, and whatever `measure` gives
    seconds     spent in steps, over all sessions
    info        how the initial cloud came about
    """

    state: State
    stepper: Stepper
    settings: Settings
    initial: np.ndarray
    history: list = field(default_factory=list)
    seconds: float = 0.0
    info: dict = field(default_factory=dict)


def run(
    scan: Scan,
    settings: Settings,
    initial: InitialCloud | None,
    seed: int = 0,
    measure=None,
    progress=None,
    path: Path | None = None,
    resume: bool = False,
) -> Fitted:
    """Fit a cloud to a scan.

    scan       the views to fit
    initial    where to start; may be None with `resume`
    seed       of the views' order, the total variation's cubes and splits
    measure    called as measure(stepper, state) at a few iterations; returns numbers for the history
    progress   called as progress(iterations done, loss=, gaussians=, **last measurement) between two steps, where
               everything is consistent: a KeyboardInterrupt that it raises leaves a checkpoint
    path       checkpoint file, written every `checkpoint_seconds` and at the end; its folder is made
    resume     go on from `path`: the same steps as without the interruption. More iterations than the checkpoint was made
               with are right where `decay_steps` sets the rates and `coarse_share` is 0
    """
    settings = bounded(settings, scan)
    stepper = Stepper(scan, settings)
    rng = np.random.default_rng(seed)
    average = Average(settings.average)
    scanned = dict(views=len(scan), scanner=describe(scan.geometry), signal=float(scan.projections.mean(dtype=float)))
    if resume:
        host, extra, arrays = checkpoint.load(path)
        _same_fit(host, extra, settings, scanned, seed, path)
        rng.bit_generator.state = extra['rng']
        points, order = arrays['initial'], [int(i) for i in arrays['order']]
        iteration, seconds, history, info = (extra[k] for k in ('iteration', 'seconds', 'history', 'info'))
        state = DeviceState(host)
        stepper.restore(arrays)
        average.restore(arrays)
    else:
        points, order = initial.points.astype(np.float32), []
        iteration, seconds, history, info = 0, 0.0, [], dict(initial.info)
        density = None if settings.render == 'alpha' else initial.density / stepper.unit
        state = DeviceState(start(points, initial.spacing, density, settings))
    marks = set(measure_at(settings.iterations))
    clock = saved = time.perf_counter()

    def store():
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            checkpoint.save(
                path,
                state.host(),
                dict(
                    seed=seed,
                    rng=rng.bit_generator.state,
                    iteration=iteration,
                    seconds=seconds + time.perf_counter() - clock,
                    history=history,
                    info=info,
                    settings=asdict(settings),
                    unit=stepper.unit,
                    **scanned,
                ),
                dict(initial=points, order=np.array(order, int)) | stepper.arrays() | average.arrays(),
            )

    while iteration < settings.iterations:
        # Not after the last step, which nothing would mend; a longer fit that goes on from there does it first.
        if iteration < settings.densify_until and (renewed := _renewed(state, stepper, settings, iteration, rng)):
            state = renewed
            average.restart()
        while len(order) < settings.batch:  # every view once before any a second time
            order += rng.permutation(len(scan)).tolist()
        views, rest = order[: settings.batch], order[settings.batch :]
        loss = stepper.step(state, views, iteration, rng)
        order, iteration = rest, iteration + 1
        average.add(state)
        if iteration in marks:
            dr.sync_thread()
            value = float(loss[0])
            if not (np.isfinite(value) and state.finite()):  # a Gaussian that is not would silently leave the image
                raise InputError(
                    f'the fit is no longer finite at iteration {iteration}: lower the rates, or check the projections'
                )
            seconds += time.perf_counter() - clock
            entry = dict(iteration=iteration, seconds=seconds, loss=value, gaussians=len(state))
            history.append(entry | (measure(stepper, average.of(state)) if measure else {}))
            clock = time.perf_counter()  # measuring is not fitting
        if progress is not None:
            last = {k: v for k, v in history[-1].items() if k.startswith('psnr')} if history else {}
            try:
                progress(iteration, loss=lambda: float(loss[0]), gaussians=len(state), **last)
            except KeyboardInterrupt:
                store()
                raise
        if time.perf_counter() - saved > settings.checkpoint_seconds:
            store()
            saved = time.perf_counter()
    state = average.of(state)
    dr.sync_thread()
    store()
    seconds += time.perf_counter() - clock
    return Fitted(state.host(), stepper, settings, points, history, seconds, info)


def _renewed(state, stepper, settings, iteration, rng):
    """The state densified and its opacities reset, as far as they are due after so many iterations; None if neither is."""
    densifying = iteration > settings.densify_from and iteration % settings.densify_every == 0
    resetting = settings.reset_every and iteration > 0 and iteration % settings.reset_every == 0
    if not (densifying or resetting):
        return None
    host = state.host()
    if densifying:
        largest = settings.prune_size if 0 < settings.reset_every < iteration else np.inf
        host = densify(host, settings, stepper.half, rng, stepper.flat, largest)
        if len(host) == 0:
            raise InputError('every Gaussian was pruned: the projections may be empty, or prune_density too high')
    return DeviceState(reset_opacity(host) if resetting else host)


def measure_at(iterations: int) -> list[int]:
    """Iterations to measure at: twelve, denser at the beginning, the last one among them."""
    return sorted({max(1, round(iterations * share**1.5)) for share in np.linspace(0, 1, 13)[1:]})


def bounded(settings: Settings, scan: Scan) -> Settings:
    """The settings with the bounds that a scan sets.

    The largest scale becomes so small that no Gaussian in the volume can reach the source: beyond it the integral of a
    cone beam's Gaussian is no footprint (see `projectors.footprint`). `values_per_gaussian` bounds the number of Gaussians.
    What is in units of the scene's radius becomes a length. Raises InputError where the source is in the volume.
    """
    g = scan.geometry
    if settings.render == 'alpha':
        radius = scene_radius(g)
        settings = replace(
            settings,
            rate_centre=tuple(radius * r for r in settings.rate_centre),
            split_size=radius * settings.split_size,
            prune_size=radius * settings.prune_size,
        )
    if settings.values_per_gaussian > 0:
        most = min(max(int(scan.projections.size / settings.values_per_gaussian), 1), settings.max_gaussians)
        settings = replace(settings, max_gaussians=most, n_points=min(settings.n_points, most))
    if g.mode == 'parallel':
        return settings
    rays = g.normalised_rays()
    room = np.linalg.norm(rays.source, axis=1).min() - np.linalg.norm(g.half)
    largest = 0.9 * room / settings.extent
    if largest <= settings.scale_min:
        raise InputError('the source lies within the volume or close to it: check DSO, nVoxel and dVoxel')
    return replace(settings, scale_max=min(settings.scale_max, largest))


def extensible(settings: Settings) -> bool:
    """Whether a longer fit begins with the very steps of a shorter one, and can go on from where that ended."""
    return settings.decay_steps > 0 and settings.coarse_share == 0 and settings.average == 0


def scene_radius(geometry) -> float:
    """3DGS's unit of length: 1.1 times the largest distance of a source from the mean of all, in the normalised frame.

    1 where there is no such distance: for a single view, and for a parallel beam, which has no source.
    """
    rays = geometry.normalised_rays()
    if rays.parallel:
        return 1.0
    return 1.1 * float(np.linalg.norm(rays.source - rays.source.mean(0), axis=1).max()) or 1.0


def _same_fit(host, extra, settings, scanned, seed, path):
    """Raise InputError where a checkpoint belongs to another fit, or its parts do not fit together."""
    damaged = InputError(f'{path}: this is not a checkpoint of a fit, or it is damaged; remove it and start again')
    if (
        not {'rng', 'seed', 'iteration', 'seconds', 'history', 'info', 'settings', 'views', 'scanner', 'signal'}
        <= extra.keys()
    ):
        raise damaged
    now = asdict(settings)
    before = {k: tuple(v) if isinstance(v, list) else v for k, v in extra['settings'].items()}
    free = {'checkpoint_seconds'}
    if extensible(settings) and extra['iteration'] <= settings.iterations:
        free.add('iterations')
    changed = [k for k in now if before.get(k) != now[k] and k not in free]
    if extra['seed'] != seed:
        changed.append('seed')
    if extra['views'] != scanned['views']:
        changed.append('views')
    elif extra['scanner'] != json.loads(json.dumps(scanned['scanner'], default=np.generic.item)):
        changed.append('the geometry')
    elif not math.isclose(
        extra['signal'], scanned['signal'], rel_tol=1e-4
    ):  # simulated anew, their last digits may differ
        changed.append('the projections')
    if changed:
        raise InputError(
            f'{path}: the checkpoint was made with other values of {", ".join(changed)}; resume with the same '
            'settings, or remove it and start again'
        )
    shapes = {k: (len(host), size) for k, size in parameters(settings).items()}
    if not (
        len(host.gradient) == len(host.seen) == len(host)
        and all(
            {k: x.shape for k, x in group.items()} == shapes and all(np.isfinite(x).all() for x in group.values())
            for group in (host.values, host.first, host.second)
        )
    ):
        raise damaged
