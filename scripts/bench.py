#!/usr/bin/env python3
"""Time the integrator, forward and backward, against a kernel written by hand for this one job.

    python scripts/bench.py
    python scripts/bench.py --gaussians 50000 --size 512 --extent 3 --json bench.json

Renders a random cloud through mi.render and differentiates it through dr.backward, Python and set-up included, and runs
scripts/limit.cpp (AVX2, two threads, nothing but the arithmetic of a pixel in a fixed box) on as many pairs, in turn, so
that both see the same machine. A pair is a pixel in the bounding box of a Gaussian's footprint. The limit needs g++.
"""
import argparse
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from lingo_mi.cli import guard
from lingo_mi.runtime import use_variant


def arguments():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--gaussians', type=int, default=50_000)
    p.add_argument('--size', type=int, default=512, help='pixels along a side of the square panel')
    p.add_argument('--pixels', type=float, default=234, help="mean pixels in a Gaussian's box")
    p.add_argument('--extent', type=float, default=3., help='cut-off in standard deviations')
    p.add_argument('--repeats', type=int, default=15)
    p.add_argument('--json', type=Path, help='write the numbers there')
    p.add_argument('--variant')
    return p.parse_args()


def build_limit(folder):
    """Compile limit.cpp, or None where there is no compiler for it."""
    program = Path(folder) / 'limit'
    source = Path(__file__).with_name('limit.cpp')
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
    scale = sigma * np.exp(rng.normal(0, .35, (n, 3)))
    data = np.concatenate([centre, scale, rng.normal(size=(n, 4))], 1)
    return data.astype(np.float32), rng.uniform(.1, 1, (n, 1)).astype(np.float32)


def main():
    args = arguments()
    variant = use_variant(args.variant)
    import drjit as dr
    import mitsuba as mi

    from lingo_mi.xray.footprint import project
    from lingo_mi.xray.objects import find_objects
    from lingo_mi.xray.sensors import view_of

    data, density = cloud(args)
    pixel = 512 / args.size
    scene = mi.load_dict(dict(
        type='scene', integrator=dict(type='lingo_xray', extent=args.extent),
        cloud=dict(type='ellipsoids', data=mi.TensorXf(data), density=mi.TensorXf(density)),
        scanner=dict(type='ct_scanner', DSO=1000., DSD=1500., nDetector=str(args.size), dDetector=str(pixel),
                     nVoxel='256', dVoxel='1', views=50)))
    params = mi.traverse(scene)
    for name in ('cloud.data', 'cloud.density'):
        dr.enable_grad(params[name])
    sensors = [scene.sensors()[0].view(i) for i in range(8)]
    thing = find_objects(scene)[0]
    f = project(thing.centre, thing.scale, thing.rotation, thing.density, view_of(sensors[0]), args.extent)
    pairs = float(dr.sum(mi.Float(f.row_end - f.row_begin) * f.width)[0])
    upstream = dr.full(mi.TensorXf, .5, (args.size, args.size, 1))
    dr.eval(upstream)

    times = dict(forward=[], backward=[])
    limits = []
    with tempfile.TemporaryDirectory() as folder:
        program = build_limit(folder) if 'llvm' in variant else None
        half = np.sqrt(pairs / args.gaussians) / 2
        for i in range(args.repeats + 3):
            start = time.perf_counter()
            image = mi.render(scene, params, sensor=sensors[i % len(sensors)])
            dr.eval(image)
            dr.sync_thread()
            middle = time.perf_counter()
            dr.backward(image * upstream)
            dr.eval(dr.grad(params['cloud.data']), dr.grad(params['cloud.density']))
            dr.sync_thread()
            end = time.perf_counter()
            for name in ('cloud.data', 'cloud.density'):
                dr.set_grad(params[name], 0)
            if i >= 3:  # warm-up
                times['forward'].append(middle - start)
                times['backward'].append(end - middle)
                if program:
                    limits.append(run_limit(program, args.gaussians, half))
    result = dict(variant=variant, gaussians=args.gaussians, pixels=args.size, extent=args.extent, pairs=int(pairs))
    for name, seconds in times.items():
        result[f'{name}_ms'] = 1e3 * float(np.median(seconds))
        result[f'{name}_ns_per_pair'] = 1e9 * float(np.median(seconds)) / pairs
    print(f'{variant}, {args.gaussians} Gaussians, {args.size} x {args.size} pixels, cut-off {args.extent:g} sigma, '
          f'{pairs / 1e6:.1f} M pairs; medians of {args.repeats}')
    for k, name in enumerate(times):
        line = f'{name:9} {result[name + "_ms"]:7.1f} ms  {result[name + "_ns_per_pair"]:5.2f} ns a pair'
        if limits:
            limit = float(np.median([x[k] for x in limits]))
            result[f'limit_{name}_ns_per_pair'] = limit
            line += f'   limit {limit:5.2f}   ratio {result[name + "_ns_per_pair"] / limit:.2f}'
        print(line)
    if limits:
        total = sum(result[f'{n}_ns_per_pair'] for n in times) / sum(result[f'limit_{n}_ns_per_pair'] for n in times)
        print(f'together ratio {total:.2f}')
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + '\n')


if __name__ == '__main__':
    guard(main)
