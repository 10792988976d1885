"""Make the pictures of the pages on concepts from a fit of the foot: `python docs/make_pictures.py`, two minutes.

25 views of 256 x 256 pixels of `scenes/x3d_foot.xml`. Writes docs/figures/lingo_steps.png (from a projection to a fitted cloud)
and docs/figures/two_stages.png (volumes from the measured views, from completed ones, and refined).
"""

from pathlib import Path

import matplotlib
import numpy as np

from lingo_mi.runtime import use_variant

matplotlib.use('agg')
import matplotlib.pyplot as plt

FIGURES = Path(__file__).resolve().parent / 'figures'
VIEWS, ITERATIONS, ALL_VIEWS = 25, 800, 100
LOW, HIGH = '#f2b705', '#d1495b'


def main():
    use_variant()
    from lingo_mi.fit.initial import initial_cloud
    from lingo_mi.fit.loop import run
    from lingo_mi.fit.settings import FAST
    from lingo_mi.results.measure import quick_measure
    from lingo_mi.scene.load import load_scene
    from lingo_mi.scene.shipped import scene_path
    from lingo_mi.scene.simulate import take_scan

    scene = load_scene(scene_path('x3d_foot'), dict(pixels='256', pixel_size='2'))
    data = take_scan(scene, VIEWS)
    settings = FAST.changed(iterations=ITERATIONS)
    start = initial_cloud(data.train, settings)
    fitted = run(data.train, settings, start, 0, quick_measure(data), lambda *_, **__: None)
    lingo_steps(data, start, fitted, settings)
    two_stages(data, fitted)


def lingo_steps(data, start, fitted, settings):
    """One picture a step: masks, occupancy, valid voxels, initial cloud, fitted cloud, volume."""
    from lingo_mi.fit.state import activate
    from lingo_mi.lingo.masks import masks
    from lingo_mi.lingo.scaling import scaled_grid
    from lingo_mi.lingo.voxel_filter import valid_voxels

    scan, geometry = data.train, data.train.geometry
    found, rays = masks(scan.normalised), geometry.normalised_rays()
    figure, panels = plt.subplots(2, 3, figsize=(11, 7.6))
    masked, coarse, cells, points, cloud, slices = panels.flat

    image = scan.projections[0]
    masked.imshow(image, cmap='gray')
    masked.contour(found.low[0], [0.5], colors=LOW, linewidths=1.2)
    masked.contour(found.high[0], [0.5], colors=HIGH, linewidths=1.2)
    masked.set_title('1  masks of every projection\nlow (yellow) and high (red)')

    resolution = settings.occupancy_voxels
    low, _ = valid_voxels(rays, found, (resolution,) * 3, geometry.half)
    coarse.imshow(depth(low, (resolution,) * 3), cmap='Blues')
    coarse.set_title(
        f'2  occupancy on {resolution}³ cells\nP = {start.info["P"]:.3f}, scaled by S = {start.info["S"]:.2f}'
    )

    grid = scaled_grid(geometry.nVoxel, start.info['S'])
    low, high = valid_voxels(rays, found, grid, geometry.half)
    red = np.ma.masked_equal(depth(high, grid), 0)
    cells.imshow(np.ma.masked_equal(depth(low, grid), 0), cmap='YlOrBr', vmin=0)
    cells.imshow(red, cmap='Reds', vmin=-red.max() / 2)
    cells.set_title(f'3  valid voxels of {grid[0]}³\n{len(low):,} low, {len(high):,} high')

    half = geometry.half
    scatter(points, start.points, start.density, half)
    points.set_title(f'4  initial cloud\n{len(start):,} points, FDK densities')
    centre, _, _, density = activate(fitted.state, fitted.settings)
    scatter(cloud, centre, density, half)
    cloud.set_title(f'5  fitted cloud\n{len(centre):,} Gaussians after {settings.iterations} steps')

    volume = fitted.stepper.volume(state_of(fitted))
    slices.imshow(sagittal(volume), cmap='gray', vmin=0, vmax=data.volume.max())
    slices.set_title('6  volume of the cloud\none slice')
    for axes in panels.flat:
        axes.set(xticks=[], yticks=[])
    save(figure, 'lingo_steps')


def two_stages(data, fitted):
    """Slices of volumes, and how far they are from the truth."""
    from lingo_mi.geometry import circular
    from lingo_mi.metrics import psnr_3d
    from lingo_mi.reconstruction.fdk import fdk
    from lingo_mi.reconstruction.refined import refined
    from lingo_mi.scan import Scan

    geometry, state = data.train.geometry, state_of(fitted)
    full = geometry.__class__(**{**vars(geometry), 'angles': circular(ALL_VIEWS, 180)})
    rendered = fitted.stepper.render(state, full) * 1.0
    every = ALL_VIEWS // len(data.train)
    rendered[::every] = data.train.projections
    completed = Scan(full, rendered)

    def sample(_):
        return fitted.stepper.volume(state)

    volumes = {
        'truth': data.volume,
        f'FDK, {VIEWS} measured views': fdk(data.train),
        f'FDK, completed to {ALL_VIEWS}': fdk(completed),
        'the cloud itself': fitted.stepper.volume(state),
        'refined from the cloud': refined(data.train, sample=sample, completed=completed).volume,
    }
    figure, panels = plt.subplots(2, len(volumes), figsize=(13, 6.4))
    top = data.volume.max()
    for (name, volume), (above, below) in zip(volumes.items(), panels.T):
        quality = '' if name == 'truth' else f'\n{psnr_3d(volume, data.volume):.1f} dB'
        above.imshow(sagittal(volume), cmap='gray', vmin=0, vmax=top)
        above.set_title(name + quality, fontsize=10.5)
        below.imshow(sagittal(volume - data.volume), cmap='RdBu_r', vmin=-0.2 * top, vmax=0.2 * top)
        above.set(xticks=[], yticks=[])
        below.set(xticks=[], yticks=[])
    panels[1, 0].set_axis_off()
    panels[1, 0].images[0].set_visible(False)
    panels[1, 0].text(0.98, 0.5, 'error,\n± 20 % of the\nlargest density', ha='right', va='center',
                      transform=panels[1, 0].transAxes, fontsize=10.5)  # fmt: skip
    save(figure, 'two_stages')


def state_of(fitted):
    from lingo_mi.fit.device import DeviceState

    return DeviceState(fitted.state)


def depth(index, grid):
    """Cells along the x axis, as an image with z upwards."""
    full = np.zeros(np.prod(grid))
    full[index] = 1
    return full.reshape(grid).sum(0).T[::-1]


def scatter(axes, points, density, half):
    """Points seen along the x axis, coloured by density, the dense ones in front."""
    order = np.argsort(density)
    axes.set_facecolor('black')
    axes.scatter(points[order, 1], points[order, 2], c=density[order], s=0.4, cmap='inferno', linewidths=0)
    axes.set(xlim=(-half[1], half[1]), ylim=(-half[2], half[2]), aspect='equal')


def sagittal(volume):
    """The slice of a volume [x, y, z] through the middle of x, z upwards."""
    return volume[volume.shape[0] // 2].T[::-1]


def save(figure, name: str):
    figure.tight_layout(h_pad=1.5)
    figure.savefig(FIGURES / f'{name}.png', dpi=110, bbox_inches='tight', pad_inches=0.05)
    plt.close(figure)


if __name__ == '__main__':
    main()
