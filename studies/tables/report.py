"""The cells of the paper's tables, and the tables as Markdown and JSON, with the paper's numbers next to ours.

The paper's numbers are means over the 15 scenes of X3D. The objects here are at most some of these, so compare the means, and
their order rather than their values.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lingo_mi.fitting.methods.by_name import method_of
from lingo_mi.storage.file_access import replacing
from lingo_mi.studies.provenance import write_provenance
from lingo_mi.studies.tables import paper
from lingo_mi.studies.tables.cells import ALGORITHMS, CT, NEW_VIEWS, Cells, Fit, Volume

TITLES = dict(
    views='New views (Table 1 of the paper)',
    ct='CT reconstruction in two stages (Table 2 of the paper)',
    ablation='Parts of LINGO (Table 3 of the paper)',
)
LABELS = dict(
    psnr_2d_r2=('PSNR', '{:.2f}'),
    ssim_2d_r2=('SSIM', '{:.4f}'),
    ipsd=('IPSD', '{:.4f}'),
    psnr_3d_r2=('PSNR', '{:.2f}'),
    ssim_3d_r2=('SSIM', '{:.4f}'),
    seconds_init=('start, s', '{:.2f}'),
)
_PAPER_IS = "The rows `paper` hold the paper's means over the 15 scenes of X3D."
NOTES = dict(
    views=f'PSNR in dB and SSIM of the 50 views held out, each view divided by its own maximum; IPSD with the longest side as '
    f'2. A method whose rates fall over the run (`fast`) keeps its own number of iterations. {_PAPER_IS}',
    ct=f'3D PSNR in dB and SSIM of volumes from the measured views (`none`) and from 100 views, the missing ones rendered from '
    f'the cloud of each method; `voxelize` samples that cloud itself, and `refined` starts there, with a pass over all views '
    f'and then passes over the measured ones (`finer`: the latter alone, on voxels of half the size, whose means it gives); all '
    f'need densities, which `3dgs` and `xgaussian` do not have. `best` is of the measured views alone. {_PAPER_IS}',
    ablation=f"Dynamic gradient scaling, latent initialisation (else R2-Gaussian's) and voxel scaling, with (+) and without "
    f'(-). New views as in Table 1, volumes by ASD-POCS as in Table 2. {_PAPER_IS}',
)
SECOND = dict(views='iterations', ct='algorithm', ablation='scale, start, voxels')

# Gradient scaling, latent initialisation and voxel scaling, each with (+) or without (-).
ABLATION = {
    '- - -': 'r2',
    '+ - -': 'r2:loss_scale=dynamic',
    '- + -': 'lingo:loss_scale=none,V_S=1',
    '+ + -': 'lingo:V_S=1',
    '- + +': 'lingo:loss_scale=none',
    '+ + +': 'lingo',
}


@dataclass(frozen=True)
class Column:
    """What a group of rows shows of one cell an object."""

    title: str
    cell: Callable[[str], Fit | Volume | None]
    fields: tuple[str, ...]
    paper: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Group:
    """The rows, one an object, of a number of views and of what `SECOND` names."""

    views: int
    second: object
    columns: tuple[Column, ...]


def groups(
    table: str,
    views: Sequence[int],
    iterations: Sequence[int],
    methods: Sequence[str],
    algorithms: Sequence[str] = (*ALGORITHMS, 'voxelize'),
) -> list[Group]:
    """The groups of a table, by rows.

    iterations   of the fits; the last one counts for `ct` and `ablation`
    methods      columns of `views` and `ct`
    algorithms   rows of `ct`
    """
    last = iterations[-1]
    if table == 'views':
        return [
            Group(n, i, tuple(Column(m, _fit(n, m, i), NEW_VIEWS, paper.VIEWS.get((n, i), {}).get(m)) for m in methods))
            for n in views
            for i in iterations
        ]
    if table == 'ct':
        return [
            Group(
                n,
                a,
                tuple(
                    Column(m, _volume(n, m, last, a), CT, paper.CT.get((n, a), {}).get(m)) for m in ('none', *methods)
                ),
            )
            for n in views
            for a in algorithms
        ]
    out = []
    for n in views:
        for parts, method in ABLATION.items():
            published = paper.ABLATION[parts] if (n, last) == (25, 30_000) else (None, None)
            out.append(
                Group(
                    n,
                    parts,
                    (
                        Column('fit', _fit(n, method, last), ('seconds_init', *NEW_VIEWS), published[0]),
                        Column('asd-pocs', _volume(n, method, last, 'asd-pocs'), CT, published[1]),
                    ),
                )
            )
    return out


def _fit(views, method, iterations):
    """The cell of an object; a method whose rates fall over the run keeps its own iterations."""
    if method_of(method).rates.decay_steps == 0:
        iterations = None
    return lambda name: Fit(name, views, method, iterations)


def _volume(views, method, iterations, algorithm):
    """The cell of an object; of the volume that a fit samples itself, the fit."""
    if algorithm in ('voxelize', 'refined', 'finer') and (method == 'none' or not method_of(method).makes_volume):
        return lambda name: None  # neither measured views nor opacities are a volume to begin with
    if method == 'none':
        return lambda name: Volume(Fit(name, views, 'none'), algorithm)
    if algorithm == 'best':
        return lambda name: None  # it holds out measured views, which a cloud has seen
    fit = _fit(views, method, iterations)
    return fit if algorithm == 'voxelize' else lambda name: Volume(fit(name), algorithm)


def plan(table_groups: list[Group], objects: Iterable[str]) -> list[Fit | Volume]:
    """All cells of a table in the order to compute them: object by object, fits before what is made of them."""
    cells = {}
    for name in objects:
        found = [cell for group in table_groups for column in group.columns if (cell := column.cell(name)) is not None]
        fits = [cell.fit if isinstance(cell, Volume) else cell for cell in found]
        # Shorter fits first, since longer ones go on from them; then one fit's volumes together, since they share its views.
        order = sorted(dict.fromkeys(fits), key=lambda fit: (fit.views, fit.method, fit.iterations or 0))
        for fit in order:
            own = dict.fromkeys(cell for cell in found if isinstance(cell, Volume) and cell.fit == fit)
            cells |= dict.fromkeys([*([] if fit.method == 'none' else [fit]), *own])
    return list(cells)


def results(table_groups: list[Group], objects: Iterable[str], cells: Cells) -> list[dict]:
    """One dictionary a row: views, second, object and, by column, the numbers or None.

    Below the objects of a group stand 'mean', over those that have all of the group's cells (None where there are none), and
    'paper' where the paper has such a row.
    """
    rows = []
    for group in table_groups:

        def row(name, values, group=group):
            rows.append(dict(views=group.views, second=group.second, object=name, columns=values))

        complete = []
        for name in objects:
            values = {}
            for column in group.columns:
                found = (cell := column.cell(name)) and cells.get(cell)
                values[column.title] = found and {field: found[field] for field in column.fields}
            row(name, values)
            planned = [c.title for c in group.columns if c.cell(name) is not None]
            if planned and all(values[title] for title in planned):
                complete.append(values)
        if complete:
            row(
                f'mean of {len(complete)}',
                {
                    c.title: complete[0][c.title]
                    and {field: _mean(values[c.title][field] for values in complete) for field in c.fields}
                    for c in group.columns
                },
            )
        if any(c.paper for c in group.columns):
            row('paper', {c.title: c.paper and dict(zip(c.fields, c.paper)) for c in group.columns})
    return rows


def _mean(values):
    values = list(values)
    return None if None in values else float(np.mean(values))


def markdown(table: str, table_groups: list[Group], rows: list[dict]) -> str:
    """The rows as a Markdown table."""
    columns = table_groups[0].columns
    titles = [f'{c.title} {LABELS[field][0]}' for c in columns for field in c.fields]
    lines = [
        '| ' + ' | '.join(['views', SECOND[table], 'object', *titles]) + ' |',
        '|---:|---|---|' + '---:|' * len(titles),
    ]
    for row in rows:
        numbers = [(field, (row['columns'][c.title] or {}).get(field)) for c in columns for field in c.fields]
        shown = ['–' if x is None else LABELS[field][1].format(x) for field, x in numbers]
        lines.append('| ' + ' | '.join([str(row['views']), str(row['second']), row['object'], *shown]) + ' |')
    return '\n'.join(lines)


def write(table: str, table_groups: list[Group], objects: Iterable[str], cells: Cells, name: str) -> str:
    """Write TABLE.json, TABLE.md and TABLE.provenance.json, of the cells that there are, into their folder; returns the Markdown.

    Each cell keeps its own provenance in its own file.

    name   of the scale
    """
    rows = results(table_groups, objects, cells)
    planned = plan(table_groups, objects)
    done = sum(cells.get(cell) is not None for cell in planned)
    scale = cells.scale
    finer = f' (scanned on {scale.finer} times as many)' if scale.finer > 1 else ''
    noise = (
        f'{scale.photons:g} photons a pixel in the open beam, electronic noise of {scale.electronic_noise:g}, '
        f'line integrals up to {scale.longest:g}; '
        if scale.photons
        else ''
    )
    text = (
        f'# {TITLES[table]}\n\n{NOTES[table]}\n\nScale `{name}`: at most {scale.size} voxels a side{finer}, '
        f'{scale.pixels} x {scale.pixels} pixels, {scale.n_points:,} Gaussians to start with '
        f'(`xgaussian`: one on every eighth voxel a side); {noise}seed {cells.seed}; {done} of '
        f'{len(planned)} cells.\n\n{markdown(table, table_groups, rows)}\n'
    )
    cells.folder.mkdir(parents=True, exist_ok=True)
    for kind, content in (('json', json.dumps(rows, indent=1) + '\n'), ('md', text)):
        with replacing(cells.folder / f'{table}.{kind}') as temporary:
            temporary.write_text(content, encoding='utf-8')
    write_provenance(cells.folder / f'{table}.md')
    return text
