"""Make docs/figures/best.png: `python docs/make_best_picture.py`, a minute.

The phantom foot on 96 voxels a side, scanned by 25 views, reconstructed on 48 voxels a side.
"""

from pathlib import Path
from tempfile import gettempdir

import matplotlib
import numpy as np

import lingo_mi as lm
from lingo_mi.common.runtime import use_variant
from lingo_mi.metrics.quality import psnr_3d
from studies.regret.study import Case, Study

matplotlib.use('agg')
import matplotlib.pyplot as plt

FIGURES = Path(__file__).resolve().parent / 'figures'


def main():
    use_variant(None)
    data = Study(Path(gettempdir())).dataset(Case('foot', finer=2, views=25))
    plain = lm.reconstruct(data.train, lm.ASDPOCS())
    best = lm.reconstruct(data.train, lm.Best())
    print(best.report())
    truth, middle = data.volume, data.volume.shape[0] // 2
    figure, panels = plt.subplots(1, 5, figsize=(14, 3.6))
    shown = [
        ('truth', truth, 'gray', truth.max()),
        (f'ASD-POCS, {psnr_3d(plain.volume, truth):.1f} dB', plain.volume, 'gray', truth.max()),
        (f'best, {psnr_3d(best.volume, truth):.1f} dB', best.volume, 'gray', truth.max()),
        ('its error', np.abs(best.volume - truth), 'magma', 0.1 * truth.max()),
        ('its map of errors', best.error, 'magma', 0.1 * truth.max()),
    ]
    for axes, (title, volume, colours, top) in zip(panels, shown):
        axes.imshow(volume[middle].T, cmap=colours, vmin=0, vmax=top, origin='lower')
        axes.set_title(title)
        axes.axis('off')
    figure.tight_layout()
    figure.savefig(FIGURES / 'best.png', dpi=90)


if __name__ == '__main__':
    main()
