"""The integrator's time, forward and backward, against a kernel written by hand for this job and against Mitsuba's tree.

A random cloud is rendered through `mi.render` and differentiated through `dr.backward`, Python and set-up included. The hand-
written kernel, limit.cpp, does only the arithmetic for the same number of pairs. A pair is a Gaussian and a pixel in the
bounding box of its footprint.

    bench = Bench(Work(gaussians=10_000, size=256))
    result = bench.times()
    result |= bench.against_tree()
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.projectors.objects import find_objects
from lingo_mi.projectors.sensors import view_of
from lingo_mi.validation.alternatives import Tree, rays
from lingo_mi.validation.closed_form import NAMES, rays_and_gradients
from lingo_mi.validation.oracle import Pose
from lingo_mi.validation.pairs import count_pairs

EPSILON = 0.0128  # mm, 1e-4 of half the volume's side: the tree's error is smallest there
VIEWS, WARM_UP = 8, 3
TRIES = 5  # in a turn; the best of them counts, as in limit.cpp
PIXELS = 400  # whose errors are measured
KEYS = 'cloud.data', 'cloud.density'
PASSES = 'forward', 'backward'
TREE = 'bvh_forward_ms', 'bvh_backward_ms', 'bvh_image_error', 'bvh_gradient_error'


@dataclass(frozen=True)
class Work:
    """Task of a benchmark, and its repetitions.

    Parameters
    ----------
    gaussians : int
        In a cube of 160 mm.
    size : int
        Pixels along a side of the square panel.
    pixels : float
        Mean pixels in a Gaussian's box.
    extent : float
        Cut-off in standard deviations.
    repeats : int
        Turns of the integrator and the hand-written kernel.
    """

    gaussians: int = 50_000
    size: int = 512
    pixels: float = 234.0
    extent: float = 3.0
    repeats: int = 15


def random_ellipsoids(work: Work) -> tuple[np.ndarray, np.ndarray]:
    """Anisotropic Gaussians in a cube, sized so that their boxes have the asked-for pixels on average.

    Rows of `ellipsoids`, float32 [N, 10] (centre, scale, quaternion), and densities, float32 [N, 1].
    """
    rng = np.random.default_rng(0)
    n = work.gaussians
    centre = rng.uniform(-80, 80, (n, 3))
    # A box of 2 extent sigma on a side; magnified 1.5 times, on pixels of 512 / size mm. 1.16: the spread of the scales.
    sigma = np.sqrt(work.pixels) / (2 * work.extent) / 1.5 * 512 / work.size / 1.16
    scale = sigma * np.exp(rng.normal(0, 0.35, (n, 3)))
    rotation = rng.normal(size=(n, 4))
    data = np.concatenate([centre, scale, rotation / np.linalg.norm(rotation, axis=1, keepdims=True)], 1)
    return data.astype(np.float32), rng.uniform(0.1, 1, (n, 1)).astype(np.float32)


class Bench:
    """A cloud before a scanner, as a scene whose parameters have derivatives."""

    def __init__(self, work: Work):
        self.work = work
        self.data, self.density = random_ellipsoids(work)
        self.scene = mi.load_dict(
            dict(
                type='scene',
                integrator=dict(type='lingo_xray', extent=work.extent),
                cloud=dict(type='ellipsoids', data=mi.TensorXf(self.data), density=mi.TensorXf(self.density)),
                scanner=dict(
                    type='ct_scanner',
                    DSO=1000.0,
                    DSD=1500.0,
                    nDetector=str(work.size),
                    dDetector=str(512 / work.size),
                    nVoxel='256',
                    dVoxel='1',
                    views=50,
                ),
            )
        )
        self.params = mi.traverse(self.scene)
        for name in KEYS:
            dr.enable_grad(self.params[name])
        self.sensors = [self.scene.sensors()[0].view(i) for i in range(VIEWS)]

    def pairs(self) -> float:
        """`count_pairs` of the cloud in the first view."""
        gaussians = find_objects(self.scene)[0]
        columns = gaussians.centre, gaussians.scale, gaussians.rotation, gaussians.density
        return count_pairs(columns, view_of(self.sensors[0]), self.work.extent)

    def times(self) -> dict:
        """Milliseconds of both passes, ns a pair, and ns a pair of the hand-written kernel.

        The kernel's are None on a GPU and if g++ is missing. Integrator and kernel take turns, so that both see the same
        machine; medians of the turns; in each turn the best of TRIES counts.
        """
        work, pairs = self.work, self.pairs()
        upstream = dr.full(mi.TensorXf, 0.5, (work.size, work.size, 1))
        dr.eval(upstream)
        turns, limits = [], []
        for sensor in self.sensors[:WARM_UP]:
            self._seconds(sensor, upstream)
        with tempfile.TemporaryDirectory() as folder:
            program = build_limit(folder) if 'llvm' in str(mi.variant()) else None
            half = np.sqrt(pairs / work.gaussians) / 2
            for i in range(work.repeats):
                sensors = [self.sensors[(i + j) % VIEWS] for j in range(TRIES)]
                turns.append(np.min([self._seconds(sensor, upstream) for sensor in sensors], axis=0))
                if program:
                    limits.append(run_limit(program, work.gaussians, half))
        out = dict(
            variant=mi.variant(), gaussians=work.gaussians, pixels=work.size, extent=work.extent, pairs=int(pairs)
        )
        for k, (name, taken) in enumerate(zip(PASSES, np.median(turns, axis=0))):
            out[f'{name}_ms'] = 1e3 * float(taken)
            out[f'{name}_ns_per_pair'] = 1e9 * float(taken) / pairs
            out[f'limit_{name}_ns_per_pair'] = float(np.median([x[k] for x in limits])) if limits else None
        return out

    def _seconds(self, sensor, upstream):
        """Seconds of one image and of its derivatives."""
        start = time.perf_counter()
        image = mi.render(self.scene, self.params, sensor=sensor)
        dr.eval(image)
        dr.sync_thread()
        middle = time.perf_counter()
        dr.backward(image * upstream)
        dr.eval([dr.grad(self.params[name]) for name in KEYS])
        dr.sync_thread()
        end = time.perf_counter()
        for name in KEYS:
            dr.set_grad(self.params[name], 0)
        return middle - start, end - middle

    def against_tree(self) -> dict:
        """Milliseconds of one image and of its derivatives by marching through Mitsuba's tree, and relative errors of both ways
        on PIXELS pixels: of the image, and of the worst of the four kinds of derivatives."""
        size, rng = self.work.size, np.random.default_rng(1)
        chosen = np.sort(rng.permutation(size**2)[:PIXELS])
        weights = np.zeros(size**2, np.float32)
        weights[chosen] = rng.normal(size=len(chosen))
        view = view_of(self.sensors[0])
        starts, directions = (x[chosen] for x in Pose.of_view(view).rays())
        columns = self.data[:, :3], self.data[:, 3:6], self.data[:, 6:], self.density[:, 0]
        image, gradients = rays_and_gradients(columns, starts, directions, weights[chosen])

        def errors(rendered, by_data, by_density):
            by_data = by_data.reshape(-1, 10)
            by = (by_data[:, :3], by_data[:, 3:6], by_data[:, 6:], by_density)
            worst = max(np.linalg.norm(a - gradients[k]) / np.linalg.norm(gradients[k]) for k, a in zip(NAMES, by))
            return float(np.linalg.norm(rendered[chosen] - image) / np.linalg.norm(image)), float(worst)

        ours: Any = mi.render(self.scene, self.params, sensor=self.sensors[0])
        dr.backward(ours * mi.TensorXf(weights.reshape(ours.shape)))
        by_ours: list[Any] = [dr.grad(self.params[name]) for name in KEYS]
        our_errors = errors(ours.numpy().ravel(), *(x.numpy() for x in by_ours))
        out = dict(zip(('image_error', 'gradient_error'), our_errors))

        tree = Tree(mi.TensorXf(self.data), mi.TensorXf(self.density), self.work.extent, EPSILON)
        start = rays(view, 2 * 128.0)
        first_ray: Any = [type(x)(dr.gather(type(x), x, dr.arange(mi.UInt32, 1))) for x in start]
        dr.eval(first_ray)
        tree.image(*first_ray)  # builds the tree, and compiles
        tree.gradients(first_ray[0], first_ray[1], dr.opaque(mi.Float, 1))
        image_of_tree, forward = _timed(tree.image, *start)
        gradients_of_tree, backward = _timed(tree.gradients, *start, mi.Float(weights))
        of_tree = errors(image_of_tree.numpy(), *(x.numpy() for x in gradients_of_tree))
        return out | dict(zip(TREE, (forward, backward, *of_tree)))


def _timed(function, *arguments):
    """The result of a function, and the milliseconds that it takes."""
    begun = time.perf_counter()
    out = function(*arguments)
    dr.sync_thread()
    return out, 1e3 * (time.perf_counter() - begun)


def build_limit(folder: PathLike | str) -> Path | None:
    """Compile limit.cpp into a folder; None if there is no compiler for it."""
    program = Path(folder) / 'limit'
    source = Path(str(resources.files('lingo_mi.validation') / 'limit.cpp'))
    command = ['g++', '-O3', '-march=native', '-pthread', str(source), '-o', str(program)]
    if shutil.which('g++') is None or subprocess.run(command, capture_output=True).returncode:
        return None
    return program


def run_limit(program: Path, count: int, half: float) -> list[float]:
    """ns per pair, forward and backward, best of the program's five repeats.

    Parameters
    ----------
    count : int
        Number of Gaussians.
    half : float
        Side of their boxes, halved, in pixels.
    """
    lines = subprocess.run([program, str(count), f'{half:.3f}'], capture_output=True, text=True, check=True).stdout
    return [float(line.split(',')[2].split()[0]) for line in lines.splitlines()]


def describe_times(result: dict, repeats: int) -> str:
    """Describe the result of `Bench.times` as lines of text."""
    lines = [
        f'{result["variant"]}, {result["gaussians"]} Gaussians, {result["pixels"]} x {result["pixels"]} pixels, '
        f'cut-off {result["extent"]:g} sigma, {result["pairs"] / 1e6:.1f} M pairs; medians of {repeats} turns'
    ]
    ours, limits = ([result[f'{key}{name}_ns_per_pair'] for name in PASSES] for key in ('', 'limit_'))
    for name, ns, limit in zip(PASSES, ours, limits):
        line = f'{name:9} {result[f"{name}_ms"]:7.1f} ms  {ns:5.2f} ns a pair'
        lines.append(line if limit is None else f'{line}   limit {limit:5.2f}   ratio {ns / limit:.2f}')
    if None not in limits:
        lines.append(f'together ratio {sum(ours) / sum(limits):.2f}')
    return '\n'.join(lines)


def describe_tree(result: dict) -> str:
    """Describe the result of `Bench.against_tree` beside the result of `Bench.times`, as lines of text."""
    forward, backward = (result[f'bvh_{name}_ms'] for name in PASSES)
    return '\n'.join(
        [
            f'tree      {forward:7.0f} ms forward, {backward:.0f} ms backward (epsilon {EPSILON:g} mm)',
            f'          {forward / result["forward_ms"]:.0f} and {backward / result["backward_ms"]:.0f} times ours',
            f'errors    image {result["image_error"]:.1e}, worst derivative {result["gradient_error"]:.1e}; '
            f'tree {result["bvh_image_error"]:.1e}, {result["bvh_gradient_error"]:.1e}; '
            f'on {min(PIXELS, result["pixels"] ** 2)} pixels',
        ]
    )
