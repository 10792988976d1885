"""Ways to compute an image and its derivatives: one function per table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.projectors import grid
from lingo_mi.projectors.balance import SHARING
from lingo_mi.projectors.view import vector64
from lingo_mi.projectors.voxelize import Lattice, voxelize
from lingo_mi.validation import alternatives
from lingo_mi.validation.accuracy.compare import Method, by_function, by_integrator, compare, split
from lingo_mi.validation.accuracy.sizes import Sizes
from lingo_mi.validation.accuracy.workload import Workload

EPSILONS = 1e-3, 1e-4, 1e-5
EXTENT = 5.0


def cutoff(
    work: Workload, sizes: Sizes, extents: Iterable[float] = (2.0, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0)
) -> list[dict]:
    """Cut-off from 2 to 8 standard deviations."""
    rows = compare(work, [by_integrator(f'{e:g}', work, extent=e) for e in extents], sizes)
    for row in rows:
        row['pairs'] = work.pairs(float(row['name']))
    return rows


def footprint(work: Workload, sizes: Sizes) -> list[dict]:
    """The affine model against the exact one, cone and parallel."""
    parallel = Workload(sizes.gaussians, sizes.pixels, sizes.box, mode='parallel')
    rows = []
    for beam, of in (('cone', work), ('parallel', parallel)):
        rows += compare(
            of,
            [by_integrator(f'{model}, {beam} beam', of, extent=6.0, footprint=model) for model in ('exact', 'affine')],
            sizes,
        )
    return rows


def methods(work: Workload, sizes: Sizes) -> list[dict]:
    """The splat, the closed form on every ray in three precisions, grids walked exactly and marched."""
    compared = [by_integrator(f'splat, {e:g} σ', work, extent=e) for e in (2.0, 3.0, 4.0, EXTENT, 7.0)]
    compared.append(by_integrator('splat, affine, 7 σ', work, extent=7.0, footprint='affine'))
    for p in ('float32', 'compensated', 'float64'):

        def per_ray(centre, scale, rotation, density, p=p):
            return alternatives.per_ray(centre, scale, rotation, density, work.view, p)

        compared.append(by_function(f'every ray, {p}', work, per_ray, p != 'compensated'))
    for n in sizes.grids:
        compared.append(by_function(f'grid {n}³, exact walk', work, lambda *x, n=n: _through_grid(work, x, n)))
        compared += [
            by_function(
                f'grid {n}³, steps of {step:g} voxel', work, lambda *x, n=n, s=step: _through_grid(work, x, n, s)
            )
            for step in (1.0, 0.5)
        ]
    return compare(work, compared, sizes)


def _through_grid(work: Workload, gaussians, n: int, step: float | None = None):
    """The image of a cloud sampled on n^3 voxels: walked exactly, or marched with steps of `step` voxels."""
    side = 2 / n
    centre, scale, rotation, density = gaussians
    voxels = Lattice(vector64((-1, -1, -1)), vector64((side,) * 3), (n, n, n))
    data = voxelize(centre, scale, rotation, density, voxels, EXTENT)
    origin, direction = alternatives.rays(work.view, 2.0)
    if step:
        return alternatives.march(data, n, 1.0, origin, direction, step * side)
    i, count = dr.arange(mi.UInt32, n**3), dr.opaque(mi.UInt32, n)
    z, rest = i % count, i // count
    data = dr.gather(mi.Float, data, (z * count + rest % count) * count + rest // count, mode=dr.ReduceMode.Permute)
    return grid.line_integrals(data, (n,) * 3, (-1, -1, -1), (1, 1, 1), grid.Lines(origin, direction))


def marching(work: Workload, sizes: Sizes) -> list[dict]:
    """Mitsuba's tree over `ellipsoids`, and how many rays it gets wrong by more than 1e-3 of the image's maximum."""
    compared = [by_integrator(f'splat, {EXTENT:g} σ', work, extent=EXTENT)] + [
        by_tree(work, EXTENT, e) for e in EPSILONS
    ]
    rows = compare(work, compared, sizes)
    image = work.truth[0].ravel()
    for m, row in zip(compared, rows):
        row['wrong_rays'] = float((abs(np.array(m.image()) - image) > 1e-3 * image.max()).mean())
    return rows


def by_tree(work: Workload, extent: float, epsilon: float) -> Method:
    """Marching through Mitsuba's tree, the rays starting just before the volume, where float32 is at its best."""
    tree = alternatives.Tree(work.data, work.density, extent, epsilon)
    origin, direction = alternatives.rays(work.view, 2.0)
    weights = mi.Float(work.weights.ravel())

    def image():
        return tree.image(origin, direction)

    def gradients():
        image()
        return split(*tree.gradients(origin, direction, weights))

    return Method(f'tree, epsilon {epsilon:g}', image, gradients)


def pixel(sizes: Sizes) -> list[dict]:
    """Rays a pixel, against the mean over the pixel, for Gaussians of some pixels and of half a pixel."""
    rows = []
    for box in (sizes.box, sizes.box / 20):
        work = Workload(sizes.few // 2, sizes.pixels, box, order=4)
        rows += compare(
            work,
            [
                by_integrator(
                    f'{f"{n} × {n}" if isinstance(n, int) else n}, σ of {work.sigma:.1f} pixels',
                    work,
                    extent=7.0,
                    pixel=n,
                )
                for n in ('centre', 2, 4, 'area')
            ],
            sizes,
        )
    return rows


def teams(work: Workload, sizes: Sizes) -> list[dict]:
    """Into how many shares the work is cut, in parts of the usual number, and how many lanes work on one."""
    compared = [
        by_integrator(f'{factor:g}', work, sharing=SHARING.scaled(factor), extent=EXTENT)
        for factor in (0.25, 0.5, 1, 2, 4, 16)
    ]
    for lanes in (4, 16):
        factor = SHARING.lanes / lanes
        sharing = replace(SHARING.scaled(factor), lanes=lanes)
        compared.append(by_integrator(f'{factor:g}, of {lanes} lanes', work, sharing=sharing, extent=EXTENT))
    return compare(work, compared, sizes)
