"""Make the pictures of the pages on concepts from fits of the foot: `python docs/make_pictures.py`, six minutes.

25 views of 256 x 256 pixels of `scenes/x3d_foot.xml`. Writes docs/figures/lingo_steps.png (LINGO, projections to a cloud) and
docs/figures/two_stages.png (volumes from the measured views, from completed ones, and refined).
"""

from pathlib import Path

import matplotlib
import numpy as np

import lingo_mi as lm
from lingo_mi.lingo.masks import masks
from lingo_mi.lingo.scaling import scaled_grid
from lingo_mi.lingo.voxel_filter import valid_voxels
from lingo_mi.metrics.quality import psnr_3d_r2

matplotlib.use('agg')
import matplotlib.pyplot as plt

FIGURES = Path(__file__).resolve().parent / 'figures'
VIEWS, STEPS, ALL_VIEWS = 25, 5000, 100  # steps of LINGO
LOW, HIGH = '#f2b705', '#d1495b'


def main():
    data = lm.simulate('x3d_foot', views=VIEWS, parameters=dict(pixels=256, pixel_size=2))
    lingo_steps(data, lm.fit(data, lm.LINGO(iterations=STEPS)))
    two_stages(data, lm.fit(data, lm.Fast()))


def lingo_steps(data, fit):
    """One picture a step: masks, occupancy, valid voxels, initial cloud, fitted cloud, volume."""
    scan, geometry = data.train, data.train.geometry
    start = fit.method.starting_cloud(scan)
    found, rays = masks(scan.normalised), geometry.normalised_rays()
    figure, panels = plt.subplots(2, 3, figsize=(11, 7.6))
    masked, coarse, cells, points, cloud, slices = panels.flat

    masked.imshow(scan.projections[0], cmap='gray')
    masked.contour(found.low[0], [0.5], colors=LOW, linewidths=1.2)
    masked.contour(found.high[0], [0.5], colors=HIGH, linewidths=1.2)
    masked.set_title('1  masks of every projection\nlow (yellow) and high (red)')

    resolution = fit.method.start.occupancy_voxels
    low, _ = valid_voxels(rays, found, (resolution,) * 3, geometry.grid.half)
    coarse.imshow(depth(low, (resolution,) * 3), cmap='Blues')
    coarse.set_title(
        f'2  occupancy on {resolution}³ cells\nP = {start.info["P"]:.3f}, scaled by S = {start.info["S"]:.2f}'
    )

    grid = scaled_grid(geometry.grid.shape, start.info['S'])
    low, high = valid_voxels(rays, found, grid, geometry.grid.half)
    red = np.ma.masked_equal(depth(high, grid), 0)
    cells.imshow(np.ma.masked_equal(depth(low, grid), 0), cmap='YlOrBr', vmin=0)
    cells.imshow(red, cmap='Reds', vmin=-red.max() / 2)
    cells.set_title(f'3  valid voxels of {grid[0]}³\n{len(low):,} low, {len(high):,} high')

    scatter(points, start.points / geometry.grid.scale, start.density, geometry)
    points.set_title(f'4  initial cloud\n{len(start):,} points, mean pixels for densities')
    scatter(cloud, fit.gaussians.means, fit.gaussians.density, geometry)
    cloud.set_title(f'5  fitted cloud\n{len(fit):,} Gaussians after {fit.steps} steps')
    slices.imshow(sagittal(fit.volume()), cmap='gray', vmin=0, vmax=data.volume.max())
    slices.set_title('6  volume of the cloud\none slice')
    for axes in panels.flat:
        axes.set(xticks=[], yticks=[])
    save(figure, 'lingo_steps')


def two_stages(data, fit):
    """Slices of volumes, and how far they are from the truth."""
    scan = data.train
    volumes = {
        'truth': data.volume,
        f'FDK, {VIEWS} measured views': lm.reconstruct(scan, lm.FDK()).volume,
        f'FDK, completed to {ALL_VIEWS}': lm.reconstruct(scan, lm.FDK(), start=fit, views=ALL_VIEWS).volume,
        'the cloud itself': fit.volume(),
        'refined from the cloud': lm.reconstruct(scan, lm.Refined(), start=fit, views=ALL_VIEWS).volume,
    }
    figure, panels = plt.subplots(2, len(volumes), figsize=(13, 5.7))
    top = data.volume.max()
    for (name, volume), (above, below) in zip(volumes.items(), panels.T):
        quality = '' if name == 'truth' else f'\n{psnr_3d_r2(volume, data.volume):.1f} dB'
        above.imshow(sagittal(volume), cmap='gray', vmin=0, vmax=top)
        above.set_title(name + quality, fontsize=10.5)
        if name == 'truth':
            below.text(0.98, 0.5, 'error,\n± 20 % of the\nlargest density', ha='right', va='center', fontsize=10.5)
            below.set_axis_off()
        else:
            below.imshow(sagittal(volume - data.volume), cmap='RdBu_r', vmin=-0.2 * top, vmax=0.2 * top)
        for axes in (above, below):
            axes.set(xticks=[], yticks=[])
    save(figure, 'two_stages')


def depth(index, grid):
    """Cells along the x axis, as an image with z upwards."""
    full = np.zeros(np.prod(grid))
    full[index] = 1
    return full.reshape(grid).sum(0).T[::-1]


def scatter(axes, points, density, geometry):
    """Points [N, 3], mm, seen along the x axis, coloured by density, the dense ones in front."""
    order = np.argsort(density)
    _, y, z = np.array(geometry.grid.size) / 2
    axes.set_facecolor('black')
    axes.scatter(points[order, 1], points[order, 2], c=density[order], s=0.4, cmap='inferno', linewidths=0)
    axes.set(xlim=(-y, y), ylim=(-z, z), aspect='equal')


def sagittal(volume):
    """The slice of a volume [x, y, z] through the middle of x, z upwards."""
    return volume[volume.shape[0] // 2].T[::-1]


def save(figure, name: str):
    figure.tight_layout(h_pad=1.5)
    figure.savefig(FIGURES / f'{name}.png', dpi=110, bbox_inches='tight', pad_inches=0.05)
    plt.close(figure)


if __name__ == '__main__':
    main()
