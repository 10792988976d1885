"""Make docs/figures/chest.png from a real CT: truth, fit and error of a slice, and a new view beside the true one.

    LINGO_MI_DATA=... python docs/make_chest_picture.py

The CT is chest_lidc0314.nii.gz (LIDC-IDRI-0314, CC BY 3.0, Armato et al. 2011) of the folder that LINGO_MI_DATA names; the fit is
that of `lingo-mi fit chest --volume ... --views 25` and takes three to eight minutes. A result that is there is used as it is.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np

from lingo_mi.files.images import read_exr
from lingo_mi.files.volumes import read_volume
from lingo_mi.geometry.grid import Grid
from lingo_mi.metrics.quality import current_names

matplotlib.use('agg')
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
VOLUME = 'chest_lidc0314.nii.gz'
SLICE = 0.46  # share of the height at which the slice is
VIEW = 8  # of those held out
WINDOW = 0.0, 0.5  # densities from black to white: HU from -1000 to 500


def arguments():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--out', type=Path, default=ROOT / 'out' / 'chest_picture', help='folder of the fit')
    return p.parse_args()


def fit(volume: Path, out: Path):
    """The fit, unless it is there."""
    if not (out / 'metrics.json').exists():
        command = [sys.executable, ROOT / 'scripts' / 'fit.py', ROOT / 'scenes' / 'chest.xml', '--volume', volume]
        subprocess.run([*map(str, command), '--views', '25', '--out', str(out)], check=True)


def held_out(volume: Path, index: int) -> np.ndarray:
    """The true projection of a held-out view, [v, u]."""
    from lingo_mi.common.runtime import use_variant

    use_variant()
    from lingo_mi.projectors import grid
    from lingo_mi.scene.load import load_scene

    scanner = load_scene(ROOT / 'scenes' / 'chest.xml').scanner
    data = read_volume(volume)
    return grid.project_volume(
        data.data, scanner.test_geometry.on(Grid(data.data.shape, data.spacing)).subset([index])
    )[0]


def main():
    out = arguments().out
    volume = Path(os.environ['LINGO_MI_DATA']) / VOLUME
    fit(volume, out)
    metrics = current_names(json.loads((out / 'metrics.json').read_text(encoding='utf-8')))
    truth, found = read_volume(volume).data, read_volume(out / 'volume.nii.gz').data
    height = round(SLICE * truth.shape[2])
    inside = slice(14, -14), slice(40, -28)  # the body
    true_slice, fitted = truth[..., height][inside].T, found[..., height][inside].T
    lit = slice(52, -58), slice(60, -42)  # of the panel
    true_view, view = held_out(volume, VIEW)[lit], read_exr(out / 'views' / f'{VIEW:04d}.exr')[lit]

    panels = [
        ('truth', true_slice, 'gray', WINDOW),
        (f'fit of 25 views: {metrics["psnr_3d_r2"]:.1f} dB', fitted, 'gray', WINDOW),
        ('error, ± 10 % of the scale', fitted - true_slice, 'RdBu_r', (-0.1, 0.1)),
        ('a view held out', true_view, 'gray', (0, true_view.max())),
        (f'rendered: {metrics["psnr_2d"]:.1f} dB', view, 'gray', (0, true_view.max())),
    ]
    across = 1.28 * np.array([image.shape[1] / image.shape[0] for _, image, *_ in panels])
    figure, all_axes = plt.subplots(1, len(panels), figsize=(2 * across.sum(), 2.9), width_ratios=across)
    for axes, (title, image, colours, (low, high)) in zip(all_axes, panels):
        axes.imshow(image, cmap=colours, vmin=low, vmax=high, aspect='equal')
        axes.set_title(title, fontsize=10)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    figure.subplots_adjust(left=0.005, right=0.995, top=0.9, bottom=0.01, wspace=0.03)
    figure.savefig(ROOT / 'docs' / 'figures' / 'chest.png', dpi=110)


if __name__ == '__main__':
    main()
