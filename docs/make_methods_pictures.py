"""Make the pictures of the page on the paper's tables: `python docs/make_methods_pictures.py`, an hour on two cores.

Fits of the foot by the four methods of the paper from 5, 10 and 25 views, in the small regime of `python -m studies.tables`.
Writes docs/figures/methods_views.png (a held-out view) and docs/figures/methods_volumes.png (a slice by ASD-POCS from completed
views). The fits stay in out/methods, so the same command goes on after an interruption.
"""

from pathlib import Path

import matplotlib

import lingo_mi as lm
from lingo_mi.metrics.quality import psnr_2d, psnr_3d_r2
from lingo_mi.storage.output_folder import CHECKPOINT

matplotlib.use('agg')
import matplotlib.pyplot as plt

FIGURES, OUT = Path(__file__).resolve().parent / 'figures', Path('out/methods')
SCAN = dict(size=96, voxels=96, voxel_size=256 / 96, pixels=192, pixel_size=512 / 192)
VIEWS, ALL_VIEWS, SHOWN = (5, 10, 25), 100, 12  # fitted; completed to; the held-out view in the picture
METHODS = {
    '3DGS': lm.GaussianSplatting(iterations=5000),
    'X-Gaussian': lm.XGaussian(iterations=5000),
    'R2-Gaussian': lm.R2(iterations=5000),
    'LINGO': lm.LINGO(iterations=5000),
}
SMALL = dict(n_points=7000, V_S=7.5)  # of a scan of this size, as in the tables


def main():
    views, volumes = {}, {}
    for count in VIEWS:
        data = lm.simulate('x3d_foot', views=count, parameters=SCAN)
        truth, test = data.test.projections[SHOWN], data.test.geometry.subset([SHOWN])
        views[count] = {'truth': (truth, '')}
        volumes[count] = {
            'truth': (sagittal(data.volume), ''),
            'measured views': slice_of(lm.reconstruct(data.train, lm.ASDPOCS(niter=10)).volume, data.volume),
        }
        for name, method in METHODS.items():
            fit = fitted(data, method, OUT / f'{name}_{count}')
            image = fit.render(test)[0]
            views[count][name] = image, f'{psnr_2d(image[None], truth[None]):.1f} dB'
            volume = lm.reconstruct(data.train, lm.ASDPOCS(niter=10), start=fit, views=ALL_VIEWS).volume
            volumes[count][name] = slice_of(volume, data.volume)
    draw(views, 'methods_views')
    draw(volumes, 'methods_volumes')


def fitted(data, method, folder):
    """The fit of a method, which goes on from the checkpoint in the folder if there is one."""
    method = method.changed(**{name: value for name, value in SMALL.items() if name in method.flat()})
    return lm.fit(data, method, folder=folder, resume=(folder / CHECKPOINT).exists())


def slice_of(volume, truth):
    """A slice and the quality of the whole volume."""
    return sagittal(volume), f'{psnr_3d_r2(volume, truth):.1f} dB'


def sagittal(volume):
    """The slice of a volume [x, y, z] through the middle of x, z upwards."""
    return volume[volume.shape[0] // 2].T[::-1]


def draw(rows, name: str):
    """A row for each number of views, a column for each method; images of a row share their range."""
    figure, panels = plt.subplots(len(rows), len(rows[VIEWS[0]]), figsize=(2.1 * len(rows[VIEWS[0]]), 2.3 * len(rows)))
    for line, (count, images) in zip(panels, rows.items()):
        top = images['truth'][0].max()
        for axes, (title, (image, quality)) in zip(line, images.items()):
            axes.imshow(image, cmap='gray', vmin=0, vmax=top)
            axes.set(xticks=[], yticks=[], xlabel=quality)
            if count == VIEWS[0]:
                axes.set_title(title, fontsize=11)
        line[0].set_ylabel(f'{count} views', fontsize=11)
    figure.tight_layout(h_pad=0.8)
    figure.savefig(FIGURES / f'{name}.png', dpi=100, bbox_inches='tight', pad_inches=0.05)
    plt.close(figure)


if __name__ == '__main__':
    main()
