"""Time the integrator, forward and backward, against a kernel written by hand for this job and against Mitsuba's tree.

    python scripts/bench.py
    python scripts/bench.py --gaussians 50000 --size 512 --extent 3 --json bench.json

Renders a random cloud through mi.render and differentiates it through dr.backward, Python and set-up included, and runs
scripts/limit.cpp (AVX2, two threads, nothing but the arithmetic of a pixel in a fixed box) on as many pairs, in turn, so
that both see the same machine; the best of five counts for both, and the median of all turns is printed. A pair is a pixel
in the bounding box of a Gaussian's footprint. The limit needs g++.

Then, once, the same cloud and image by marching through the tree of `ellipsoids`, hit by hit, and both ways' errors
against float64 on some of the pixels. That takes a minute; --no-bvh leaves it out. What was not measured is null in the JSON.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
import time
from importlib import resources
from pathlib import Path

import numpy as np

from lingo_mi.cli.common import Parser
from lingo_mi.errors import InputError
from lingo_mi.runtime import use_variant

EPSILON = 0.0128  # mm, 1e-4 of half the volume's side: where the tree errs least
TRIES = 5  # in a turn, of which the best counts, as in limit.cpp
PIXELS = 400  # of which errors are measured
MOST_PIXELS = 30_000  # a larger box would leave limit.cpp's image
TREE = 'bvh_forward_ms', 'bvh_backward_ms', 'bvh_image_error', 'bvh_gradient_error'


def arguments():
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--gaussians', type=int, default=50_000)
    p.add_argument('--size', type=int, default=512, help='pixels along a side of the square panel')
    p.add_argument('--pixels', type=float, default=234, help="mean pixels in a Gaussian's box")
    p.add_argument('--extent', type=float, default=3.0, help='cut-off in standard deviations')
    p.add_argument('--repeats', type=int, default=15, help='turns')
    p.add_argument('--no-bvh', dest='bvh', action='store_false', help="leave out Mitsuba's tree")
    p.add_argument('--json', type=Path, help='write the numbers there')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    args = p.parse_args()
    for name, low, high in (
        ('gaussians', 1, 10_000_000),
        ('size', 8, 8192),
        ('pixels', 1, MOST_PIXELS),
        ('extent', 1, 20),
        ('repeats', 1, 10_000),
    ):
        if not low <= getattr(args, name) <= high:
            raise InputError(f'--{name} must be from {low} to {high}, not {getattr(args, name):g}')
    return args


def build_limit(folder):
    """Compile limit.cpp, or None where there is no compiler for it."""
    program = Path(folder) / 'limit'
    source = Path(str(resources.files('lingo_mi.studies.benchmarks') / 'limit.cpp'))
    command = ['g++', '-O3', '-march=native', '-pthread', str(source), '-o', str(program)]
    if shutil.which('g++') is None or subprocess.run(command, capture_output=True).returncode:
        return None
    return program


def run_limit(program, count, half):
    """ns per pair, forward and backward, best of the program's five repeats."""
    lines = subprocess.run([program, str(count), f'{half:.3f}'], capture_output=True, text=True, check=True).stdout
    return [float(line.split(',')[2].split()[0]) for line in lines.splitlines()]


def cloud(args):
    """A scene of anisotropic Gaussians in a ball, sized so that their boxes have the asked-for pixels on average."""
    rng = np.random.default_rng(0)
    n = args.gaussians
    centre = rng.uniform(-80, 80, (n, 3))
    # A box of 2 extent sigma on a side; magnified 1.5 times, on pixels of 512 / size mm. 1.16: the spread of the scales.
    sigma = np.sqrt(args.pixels) / (2 * args.extent) / 1.5 * 512 / args.size / 1.16
    scale = sigma * np.exp(rng.normal(0, 0.35, (n, 3)))
    rotation = rng.normal(size=(n, 4))
    data = np.concatenate([centre, scale, rotation / np.linalg.norm(rotation, axis=1, keepdims=True)], 1)
    return data.astype(np.float32), rng.uniform(0.1, 1, (n, 1)).astype(np.float32)


def against_tree(scene, sensor, data, density, args, ours_ms) -> dict:
    """Time one image and its derivatives by marching through Mitsuba's tree; errors of both ways on a few pixels."""
    import drjit as dr
    import mitsuba as mi

    from lingo_mi.projectors.sensors import view_of
    from lingo_mi.studies.alternatives import Tree, rays
    from lingo_mi.studies.closed_form import NAMES, rays_and_gradients

    view, rng = view_of(sensor), np.random.default_rng(1)
    chosen = np.sort(rng.permutation(args.size**2)[:PIXELS])
    weights = np.zeros(args.size**2, np.float32)
    weights[chosen] = rng.normal(size=len(chosen))
    source, corner, u, v = (np.array(x, float).ravel() for x in (view.source, view.corner, view.u, view.v))
    directions = corner + np.outer(chosen % args.size + 0.5, u) + np.outer(chosen // args.size + 0.5, v) - source
    columns = data[:, :3], data[:, 3:6], data[:, 6:], density[:, 0]
    starts = np.broadcast_to(source, directions.shape)
    image, gradients = rays_and_gradients(columns, starts, directions, weights[chosen])

    def errors(found, by_data, by_density):
        by = (by_data[:, :3], by_data[:, 3:6], by_data[:, 6:], by_density)
        worst = max(np.linalg.norm(a - gradients[k]) / np.linalg.norm(gradients[k]) for k, a in zip(NAMES, by))
        return float(np.linalg.norm(found[chosen] - image) / np.linalg.norm(image)), float(worst)

    def timed(function, *more):
        begun = time.perf_counter()
        out = function(*more)
        dr.sync_thread()
        return out, 1e3 * (time.perf_counter() - begun)

    params = mi.traverse(scene)
    ours = mi.render(scene, params, sensor=sensor)
    dr.backward(ours * mi.TensorXf(weights.reshape(ours.shape)))
    grads = [dr.grad(params[name]).numpy() for name in ('cloud.data', 'cloud.density')]
    out = dict(zip(('image_error', 'gradient_error'), errors(ours.numpy().ravel(), grads[0].reshape(-1, 10), grads[1])))

    tree = Tree(mi.TensorXf(data), mi.TensorXf(density), args.extent, EPSILON)
    start = rays(view, 2 * 128.0)
    upstream = mi.Float(weights)
    tree.image(*(type(x)(dr.gather(type(x), x, dr.arange(mi.UInt32, 1))) for x in start))  # builds the tree
    found, out['bvh_forward_ms'] = timed(tree.image, *start)
    by, out['bvh_backward_ms'] = timed(tree.gradients, *start, upstream)
    worst = errors(found.numpy(), by[0].numpy().reshape(-1, 10), by[1].numpy())
    out |= dict(zip(('bvh_image_error', 'bvh_gradient_error'), worst))
    print(
        f'tree      {out["bvh_forward_ms"]:7.0f} ms forward, {out["bvh_backward_ms"]:.0f} ms backward '
        f'(epsilon {EPSILON:g} mm)'
    )
    print(
        f'          {out["bvh_forward_ms"] / ours_ms["forward"]:.0f} and {out["bvh_backward_ms"] / ours_ms["backward"]:.0f} '
        'times ours'
    )
    print(
        f'errors    image {out["image_error"]:.1e}, worst derivative {out["gradient_error"]:.1e}; '
        f'tree {out["bvh_image_error"]:.1e}, {out["bvh_gradient_error"]:.1e}; on {len(chosen)} pixels'
    )
    return out


def main():
    args = arguments()
    variant = use_variant(args.variant)
    import drjit as dr
    import mitsuba as mi

    from lingo_mi.projectors.footprint import project
    from lingo_mi.projectors.objects import find_objects
    from lingo_mi.projectors.sensors import view_of

    data, density = cloud(args)
    pixel = 512 / args.size
    scene = mi.load_dict(
        dict(
            type='scene',
            integrator=dict(type='lingo_xray', extent=args.extent),
            cloud=dict(type='ellipsoids', data=mi.TensorXf(data), density=mi.TensorXf(density)),
            scanner=dict(
                type='ct_scanner',
                DSO=1000.0,
                DSD=1500.0,
                nDetector=str(args.size),
                dDetector=str(pixel),
                nVoxel='256',
                dVoxel='1',
                views=50,
            ),
        )
    )
    params = mi.traverse(scene)
    for name in ('cloud.data', 'cloud.density'):
        dr.enable_grad(params[name])
    sensors = [scene.sensors()[0].view(i) for i in range(8)]
    thing = find_objects(scene)[0]
    f = project(thing.centre, thing.scale, thing.rotation, thing.density, view_of(sensors[0]), args.extent)
    pairs = float(dr.sum(mi.Float(f.row_end - f.row_begin) * f.width)[0])
    upstream = dr.full(mi.TensorXf, 0.5, (args.size, args.size, 1))
    dr.eval(upstream)

    def seconds(sensor):
        """Seconds of one image and of its derivatives."""
        start = time.perf_counter()
        image = mi.render(scene, params, sensor=sensor)
        dr.eval(image)
        dr.sync_thread()
        middle = time.perf_counter()
        dr.backward(image * upstream)
        dr.eval(dr.grad(params['cloud.data']), dr.grad(params['cloud.density']))
        dr.sync_thread()
        end = time.perf_counter()
        for name in ('cloud.data', 'cloud.density'):
            dr.set_grad(params[name], 0)
        return middle - start, end - middle

    turns, limits = [], []
    for sensor in sensors[:3]:  # warm-up
        seconds(sensor)
    with tempfile.TemporaryDirectory() as folder:
        program = build_limit(folder) if 'llvm' in variant else None
        half = np.sqrt(pairs / args.gaussians) / 2
        for i in range(args.repeats):
            turns.append(np.min([seconds(sensors[(i + j) % len(sensors)]) for j in range(TRIES)], axis=0))
            if program:
                limits.append(run_limit(program, args.gaussians, half))
    times = dict(zip(('forward', 'backward'), np.median(turns, axis=0)))
    result = dict(variant=variant, gaussians=args.gaussians, pixels=args.size, extent=args.extent, pairs=int(pairs))
    for name, time_taken in times.items():
        result[f'{name}_ms'] = 1e3 * float(time_taken)
        result[f'{name}_ns_per_pair'] = 1e9 * float(time_taken) / pairs
    print(
        f'{variant}, {args.gaussians} Gaussians, {args.size} x {args.size} pixels, cut-off {args.extent:g} sigma, '
        f'{pairs / 1e6:.1f} M pairs; medians of {args.repeats} turns'
    )
    for k, name in enumerate(times):
        result[f'limit_{name}_ns_per_pair'] = None
        line = f'{name:9} {result[name + "_ms"]:7.1f} ms  {result[name + "_ns_per_pair"]:5.2f} ns a pair'
        if limits:
            limit = float(np.median([x[k] for x in limits]))
            result[f'limit_{name}_ns_per_pair'] = limit
            line += f'   limit {limit:5.2f}   ratio {result[name + "_ns_per_pair"] / limit:.2f}'
        print(line)
    if limits:
        total = sum(result[f'{n}_ns_per_pair'] for n in times) / sum(result[f'limit_{n}_ns_per_pair'] for n in times)
        print(f'together ratio {total:.2f}')
    result |= dict.fromkeys(TREE)
    if args.bvh:
        result |= against_tree(scene, sensors[0], data, density, args, {k: result[f'{k}_ms'] for k in times})
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + '\n')
