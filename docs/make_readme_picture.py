"""Make docs/figures/readme.png: the measured walnut by FDK and by `best` of 30 views, and by FDK of all 120.

    python docs/make_readme_picture.py

The slices are those of docs/figures/walnut_256.png, which docs/benchmarks/walnut.md says how to make.
"""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use('agg')
import matplotlib.pyplot as plt

FIGURES = Path(__file__).resolve().parent / 'figures'
SLICES = {  # titles -> row and column of the slice in the figure
    'FDK, 30 views': (0, 1),
    'lingo_mi, the same 30 views': (1, 1),
    'FDK, all 120 views': (0, 0),
}
MARGIN = 26  # pixels of air around the walnut


def extents(dark: np.ndarray) -> list[slice]:
    """Runs of lines that hold a slice; those of titles are shorter."""
    edges = np.flatnonzero(np.diff(np.r_[False, dark, False].astype(int)))
    return [slice(first, last) for first, last in edges.reshape(-1, 2) if last - first > 200]


def main():
    image = plt.imread(FIGURES / 'walnut_256.png')[..., 0]
    rows = extents((image < 1).mean(1) > 0.3)
    columns = extents((image < 1).mean(0) > 0.3)
    figure, panels = plt.subplots(1, 3, figsize=(9.6, 3.46))
    for axes, (title, (row, column)) in zip(panels, SLICES.items()):
        inside = image[rows[row], columns[column]][MARGIN:-MARGIN, MARGIN:-MARGIN]
        axes.imshow(inside, cmap='gray', vmin=0, vmax=1)
        axes.set_title(title, fontsize=12)
        axes.set_axis_off()
    figure.subplots_adjust(left=0.003, right=0.997, bottom=0.005, top=0.915, wspace=0.02)
    figure.savefig(FIGURES / 'readme.png', dpi=100)


if __name__ == '__main__':
    main()
