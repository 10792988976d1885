"""Scans with an effect, reconstructed by fits that ignore it and that model it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import effects_of
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.geometry.base import Geometry
from lingo_mi.metrics.quality import psnr_3d
from lingo_mi.projectors.objects import find_objects
from lingo_mi.scan import Scan
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.shipped import scene_path
from lingo_mi.scene.simulate import render_objects, take_scan

# Small, so that a fit takes about a minute.
# No fit stops early, so that effects are compared after the same steps.
METHOD = Fast().changed(stop='off', iterations=750, densify_from=100, densify_until=450, values_per_gaussian=25.0)
FITS = dict(clean='clean scan', ignore='effect ignored', model='effect modelled')


@dataclass(frozen=True)
class Experiment:
    """An effect, how to simulate it and how to fit what it leaves.

    Parameters
    ----------
    title : str
        In tables and pictures.
    model : dict
        Options of the fit that models it, besides the options of the others.
    scene : dict
        Parameters of the scene by fit, where these differ; volumes are compared in the middle that all fits have.
    turn, shift : float
        Standard deviations of every view's motion about and along each axis, degrees and mm, that the fits are not told.
    """

    title: str
    model: dict = field(default_factory=dict)
    scene: dict = field(default_factory=dict)
    turn: float = 0.0
    shift: float = 0.0


EXPERIMENTS = dict(
    hardening=Experiment('beam hardening, 120 kVp, aluminium'),
    focal_spot=Experiment('focal spot of 2 mm, magnified 6 times'),
    psf=Experiment('point spread of 3 pixels'),
    aperture=Experiment('whole area of pixels of 6 mm'),
    gain=Experiment('gains that differ by 5 %', scene=dict(ignore=dict(corrected='false'))),
    saturation=Experiment('saturation at .6 of the open beam'),
    bits=Experiment('converter of 6 bits', dict(weights='noise')),
    dead_pixels=Experiment('every tenth pixel dead'),
    misalignment=Experiment(
        'views turned by .5 degrees, shifted by 1 mm', dict(rate_pose=(2e-3, 2e-4)), turn=0.5, shift=1.0
    ),
    scatter=Experiment('scatter and hardening of a chest, 120 kVp'),
    noise=Experiment('noise of 3000 photons a pixel', dict(weights='noise')),
    truncation=Experiment(
        'panel of half the width', scene=dict(clean=dict(across='64', columns='96'), model=dict(across='64'))
    ),
)


def experiment_of(name: str) -> Experiment:
    """The experiment of a name.

    Raises
    ------
    InputError
        If there is none.
    """
    if name not in EXPERIMENTS:
        raise InputError(f'there is no experiment {name!r}: choose one of {", ".join(EXPERIMENTS)}')
    return EXPERIMENTS[name]


def measure(name: str, parameters: dict | None = None, method: Method = METHOD, seed: int = 0) -> dict:
    """The experiment `name`: a scan of its scene and one without the effect, three fits, and their errors.

    Parameters
    ----------
    parameters : dict or None
        Parameters of the scene file (`<default>` names).

    Returns
    -------
    dict
        Title, the largest line integral of the clean scan, and for each of FITS: psnr_3d (the truth's maximum is full scale),
        psnr_3d_gain (after the factor that fits the truth best, so that a wrong scale alone costs nothing), ms_per_iteration
        (over the second half of the steps, when all is compiled), seconds (of start and steps), volume; also truth [x, y, z],
        1/mm, and spacing, mm.

    Raises
    ------
    InputError
        For an unknown name.
    """
    experiment = experiment_of(name)
    scenes, results = {}, {}
    for kind, changes in dict(clean={}, ignore=dict(effects='ignore'), model=experiment.model).items():
        values = (parameters or {}) | experiment.scene.get(kind, {})
        key = tuple(sorted(values.items()))
        if key not in scenes:
            scenes[key] = scans(name, values, seed)
        what, chosen = scenes[key]['clean' if kind == 'clean' else 'scan'], method.changed(**changes)
        fit = run(what, chosen, seed)
        results[kind] = fit.volume(), dict(ms_per_iteration=pace(fit.history), seconds=fit.seconds)
    first = next(iter(scenes.values()))  # of the clean scan
    shape = np.min([volume.shape for volume, _ in results.values()], 0)
    truth = middle(first['truth'], shape)
    fits = {
        kind: quality(middle(volume, shape), truth) | times | dict(volume=middle(volume, shape))
        for kind, (volume, times) in results.items()
    }
    return dict(
        title=experiment.title,
        largest=float(first['clean'].projections.max()),
        truth=truth,
        spacing=list(first['clean'].geometry.grid.spacing),
        **fits,
    )


def scans(name: str, parameters: dict, seed: int) -> dict:
    """A clean scan of an experiment's scene, a scan with its effect, and the truth [x, y, z], None if the grid is not the
    object's own."""
    experiment, loaded = EXPERIMENTS[name], load_scene(scene_path(f'effects/{name}'), parameters)
    dataset = take_scan(loaded, seed=seed)
    scan, objects = dataset.train, find_objects(loaded.scene)
    clean = Scan(scan.geometry, render_objects(objects, scan.geometry))
    if experiment.turn or experiment.shift:
        moved = misaligned(scan.geometry, experiment.turn, experiment.shift, seed)
        scan = Scan(scan.geometry, render_objects(objects, moved))
    effects = effects_of(scan)
    if effects and effects.scatter:  # a fit must not know the random numbers of its data, and may be quicker
        scatter = replace(effects.scatter, paths=-(-effects.scatter.paths // 4), seed=effects.scatter.seed + 1)
        scan = replace(scan, effects=replace(effects, scatter=scatter))
    return dict(clean=clean, scan=scan, truth=dataset.volume)


def middle(volume: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """The middle of a volume [x, y, z] of at least a shape."""
    first = [(n - m) // 2 for n, m in zip(volume.shape, shape)]
    return volume[tuple(slice(a, a + m) for a, m in zip(first, shape))]


def misaligned(geometry: Geometry, turn: float, shift: float, seed: int) -> Geometry:
    """The geometry with every view turned about the volume's centre and shifted at random: standard deviations about and
    along each axis, degrees and mm. The mean motion, which no projection tells from the object's, is taken off."""
    turns, shifts = np.random.default_rng(seed).normal(size=(2, len(geometry), 3))
    turns, shifts = np.radians(turn) * (turns - turns.mean(0)), shift * (shifts - shifts.mean(0))
    rays = geometry.rays().moved(Rotation.from_rotvec(turns).as_matrix(), shifts)
    return Geometry.from_poses(rays, geometry.nDetector, grid=geometry.grid)


def quality(volume: np.ndarray, truth: np.ndarray) -> dict:
    """PSNR in dB of a volume [x, y, z] against the truth, whose maximum is full scale: as it is, and after the factor that
    makes the error least."""
    gain = np.vdot(volume, truth) / max(np.vdot(volume, volume), 1e-30)
    return dict(psnr_3d=psnr_3d(volume, truth), psnr_3d_gain=psnr_3d(gain * volume, truth))


def pace(history: list[dict]) -> float:
    """Milliseconds a step, over about the second half of a fit's steps."""
    last = history[-1]
    first = next(h for h in history if 2 * h['iteration'] >= last['iteration'] or h is history[-2])
    return 1e3 * (last['seconds'] - first['seconds']) / (last['iteration'] - first['iteration'])
