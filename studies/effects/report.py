"""The report of the experiments on effects: numbers, a table, a picture of each, and their provenance."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from lingo_mi.report.figures import PADS, STYLE, plane, plane_extent, richest
from lingo_mi.storage.file_access import read_object, replacing, write_text
from lingo_mi.validation.markdown import insert_into, table
from lingo_mi.validation.provenance import provenance, write_provenance
from studies.effects.experiments import EXPERIMENTS, FITS

TABLE = 'worth'  # its name in the document


def write(results: dict[str, dict], folder: Path, figures: Path, document: Path | None = None) -> dict[str, dict]:
    """Write effects.json and effects.md into `folder`, a picture of every experiment into `figures`, and the table into a
    document.

    `provenance` is written beside effects.md and beside the document. Returns what effects.json holds.

    Parameters
    ----------
    results : dict[str, dict]
        Results of `experiments.measure`, by the experiments' names; effects.json keeps what it holds of others, each with its own
        `provenance`.
    document : Path or None
        A Markdown file with a place for the table `worth`; None: no document.
    """
    for path in (folder, figures):
        path.mkdir(parents=True, exist_ok=True)
    for name, result in results.items():
        draw(result, figures / f'{name}.png')
    numbers = {
        name: {k: v for k, v in result.items() if k not in ('truth', *FITS)}
        | {kind: {k: v for k, v in result[kind].items() if k != 'volume'} for kind in FITS}
        | dict(provenance=provenance())
        for name, result in results.items()
    }
    path = folder / 'effects.json'
    stored = (read_object(path) if path.exists() else {}) | numbers
    numbers = {name: stored[name] for name in EXPERIMENTS if name in stored}
    write_text(path, json.dumps(numbers, indent=1) + '\n')
    text = make_table(numbers)
    write_text(folder / 'effects.md', f'# What modelling an effect is worth\n\n{text}\n')
    write_provenance(folder / 'effects.md')
    if document:
        insert_into(document, {TABLE: text})
        write_provenance(document)
    return numbers


def make_table(numbers: dict) -> str:
    """The Markdown table of effects.json."""

    def cell(kind):
        return lambda r: f'{r[kind]["psnr_3d"]:.2f}'

    columns = [
        ('effect', lambda r: r['title']),
        *((f'{title}, dB', cell(kind)) for kind, title in FITS.items()),
        ('extra time, s', lambda r: f'{round(r["model"]["seconds"] - r["ignore"]["seconds"]):+d}'),
    ]
    return table(columns, numbers.values())


def draw(result: dict, path: Path) -> None:
    """A picture of what `experiments.measure` gave: axial slices of the truth and of both fits on one grey scale, 1/mm, and
    the errors of all three fits below on one scale of their own."""
    import matplotlib  # half a second that the fits need not wait for
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    truth, spacing = result['truth'], np.array(result['spacing'])
    index, extent = richest(truth, 2), plane_extent(truth.shape, spacing, np.zeros(3), 2)
    wanted = plane(truth, 2, index)
    slices = {kind: plane(result[kind]['volume'], 2, index) for kind in FITS}
    limit = max(np.percentile(np.abs(slices[kind] - wanted), 99) for kind in FITS)
    with matplotlib.rc_context(STYLE):
        fig = Figure(figsize=(10, 6.6), layout=ConstrainedLayoutEngine(w_pad=PADS['w_pad'], h_pad=PADS['h_pad']))
        fig.suptitle(f'{result["title"]}: slice at z = {(index + 0.5 - truth.shape[2] / 2) * spacing[2]:.3g} mm')
        grid = fig.subplots(2, 3, sharex=True, sharey=True)
        above = [('truth', wanted), *((FITS[kind], slices[kind]) for kind in ('ignore', 'model'))]
        grey, differences = (
            dict(cmap='gray', vmin=0, vmax=1.1 * wanted.max()),
            dict(cmap='RdBu_r', vmin=-limit, vmax=limit),
        )
        for ax, (title, image) in zip(grid[0], above):
            ax.imshow(image, origin='lower', extent=extent, **grey)
            ax.set_title(title)
        for ax, (kind, title) in zip(grid[1], FITS.items()):
            ax.imshow(slices[kind] - wanted, origin='lower', extent=extent, **differences)
            ax.set(title=f'error, {title}: {result[kind]["psnr_3d"]:.2f} dB', xlabel='x [mm]')
        for ax in grid[:, 0]:
            ax.set_ylabel('y [mm]')
        fig.colorbar(grid[0, 0].images[0], ax=list(grid[0]), label='density [1/mm]', aspect=22, pad=0.015)
        fig.colorbar(grid[1, 0].images[0], ax=list(grid[1]), label='difference [1/mm]', aspect=22, pad=0.015)
        with replacing(path) as temporary:
            fig.savefig(temporary, dpi=90)
