"""The cells of the paper's tables, and the tables as Markdown and JSON, with the paper's numbers next to ours.

The paper's numbers are means over the 15 scenes of X3D. The objects here are at most some of these, so compare the means, and
their order rather than their values.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lingo_mi.fitting.methods.by_name import method_of
from lingo_mi.storage.file_access import replacing
from lingo_mi.validation.provenance import write_provenance
from lingo_mi.validation.tables import paper
from lingo_mi.validation.tables.cells import ALGORITHMS, CT, NEW_VIEWS, Cells, Fit, Volume

TITLES = dict(
    views='New views (Table 1 of the paper)',
    ct='CT reconstruction in two stages (Table 2 of the paper)',
    ablation='Parts of LINGO (Table 3 of the paper)',
    controls='What makes LINGO better: controls',
    scenes='Volumes of whole fits, scene by scene',
)
LABELS = dict(
    psnr_2d_r2=('PSNR', '{:.2f}'),
    ssim_2d_r2=('SSIM', '{:.4f}'),
    ipsd=('IPSD', '{:.4f}'),
    psnr_3d_r2=('PSNR', '{:.2f}'),
    ssim_3d_r2=('SSIM', '{:.4f}'),
    seconds_init=('start, s', '{:.2f}'),
    gaussians=('Gaussians', '{:,.0f}'),
)
_PAPER_IS = (
    "The rows `paper` hold the paper's means over the 15 scenes of X3D. A mean has its standard error over the objects below it; "
    'a gain is the mean of the differences to `r2`, object by object.'
)
NOTES = dict(
    views=f'PSNR in dB and SSIM of the 50 views held out, each view divided by its own maximum; IPSD with the longest side as '
    f'2. A method whose rates fall over the run (`fast`) keeps its own number of iterations. {_PAPER_IS}',
    ct=f'3D PSNR in dB and SSIM of volumes from the measured views (`none`) and from 100 views, the missing ones rendered from '
    f'the cloud of each method; `voxelize` samples that cloud itself, and `refined` starts there, with a pass over all views '
    f'and then passes over the measured ones (`finer`: the latter alone, on voxels of half the size, whose means it gives); all '
    f'need densities, which `3dgs` and `xgaussian` do not have. `best` is of the measured views alone. {_PAPER_IS}',
    ablation=f"Dynamic gradient scaling, latent initialisation (else R2-Gaussian's) and voxel scaling, with (+) and without "
    f'(-). New views as in Table 1, volumes by ASD-POCS as in Table 2. {_PAPER_IS}',
    controls='Rows that separate what the loss scale does from what it causes (more Gaussians), and that try other readings of '
    "the paper: rates that fall over the run instead of over 30,000 steps, and other densities at the start: the paper's mean "
    'pixel, 0.15 of it (the factor that R2-Gaussian puts on FDK densities), and the factor that fits the projections best. '
    'New views as in Table 1, and the volume of the cloud itself. A mean has its standard error over the objects below it; a '
    'gain is the mean of the differences to `r2`, object by object.',
    scenes='3D PSNR in dB and SSIM of the volumes of the clouds themselves, from all views. The columns with names of papers are '
    'published for 50 views, R2-Gaussian with a densification threshold of 3e-5 and rounded to 0.1 dB for most scenes.',
)
SECOND = dict(views='iterations', ct='algorithm', ablation='scale, start, voxels', controls='row', scenes='iterations')

# Gradient scaling, latent initialisation and voxel scaling, each with (+) or without (-).
ABLATION = {
    '- - -': 'r2',
    '+ - -': 'r2:loss_scale=dynamic',
    '- + -': 'lingo:loss_scale=none,V_S=1',
    '+ + -': 'lingo:V_S=1',
    '- + +': 'lingo:loss_scale=none',
    '+ + +': 'lingo',
}

CONTROLS = {
    'r2': 'r2',
    'r2, half the densification threshold': 'r2:densify_threshold=2.5e-5',
    'r2, loss scale on the densification alone': 'r2:loss_scale=statistic',
    'r2, loss scale': 'r2:loss_scale=dynamic',
    'lingo': 'lingo',
    'lingo, loss scale on the densification alone': 'lingo:loss_scale=statistic',
    'lingo, twice the densification threshold': 'lingo:densify_threshold=1e-4',
    'lingo, densities as R2-Gaussian': 'lingo:density=r2',
    'lingo, densities of the paper': 'lingo:density=paper',
    'r2, rates that fall over the run': 'r2:decay_steps=0',
    'lingo, rates that fall over the run': 'lingo:decay_steps=0',
}


@dataclass(frozen=True)
class Column:
    """Column of a table: one cell of an object in a group of rows, or the value that others have published for it."""

    title: str
    cell: Callable[[str], Fit | Volume | None]
    fields: tuple[str, ...]
    paper: tuple[float, ...] | None = None
    published: Mapping[str, float] | None = None


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

    Parameters
    ----------
    iterations : Sequence[int]
        Iterations of the fits; the last one counts for `ct` and `ablation`.
    methods : Sequence[str]
        Columns of `views` and `ct`.
    algorithms : Sequence[str]
        Rows of `ct`.
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
    if table == 'controls':
        fields = ('psnr_2d_r2', 'ipsd', 'gaussians', *CT)

        def over(method):  # such a fit keeps its own iterations, see `_fit`
            return f'{method},iterations={last}' if 'decay_steps=0' in method else method

        return [
            Group(n, row, (Column('fit', _fit(n, over(method), last), fields),))
            for n in views
            for row, method in CONTROLS.items()
        ]
    if table == 'scenes':
        columns = [Column(m, _fit(views[-1], m, last), CT) for m in methods if method_of(m).makes_volume]
        others = [Column(title, lambda name: None, CT[:1], published=p) for title, p in paper.SCENES.items()]
        return [Group(views[-1], last, (*columns, *others))]
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
        return lambda name: None  # `best` holds out measured views, which a cloud has seen
    fit = _fit(views, method, iterations)
    return fit if algorithm == 'voxelize' else lambda name: Volume(fit(name), algorithm)


def plan(table_groups: list[Group], objects: Iterable[str]) -> list[Fit | Volume]:
    """All cells of a table in the order to compute them: object by object, fits before what is made of them."""
    cells = {}
    for name in objects:
        planned = [
            cell for group in table_groups for column in group.columns if (cell := column.cell(name)) is not None
        ]
        fits = [cell.fit if isinstance(cell, Volume) else cell for cell in planned]
        # Shorter fits first, since longer ones go on from them; then one fit's volumes together, since they share its views.
        order = sorted(dict.fromkeys(fits), key=lambda fit: (fit.views, fit.method, fit.iterations or 0))
        for fit in order:
            volumes = dict.fromkeys(cell for cell in planned if isinstance(cell, Volume) and cell.fit == fit)
            cells |= dict.fromkeys([*([] if fit.method == 'none' else [fit]), *volumes])
    return list(cells)


def results(table_groups: list[Group], objects: Iterable[str], every: Sequence[Cells]) -> list[dict]:
    """One dictionary a row: views, second, object and, by column, the numbers or None.

    Below the objects of a group stand, over those that have all of the group's cells (nothing if there are none): 'mean' and its
    standard error; for two seeds and more the 'spread over seeds', the standard deviation of a single run; and 'gain over r2' and
    its standard error. 'paper' comes last if the paper has such a row.

    Parameters
    ----------
    every : Sequence[Cells]
        The cells of each seed; an object has its mean over the seeds that have it.
    """
    rows: list[dict] = []
    base: dict[int, Values] = {}
    for group in table_groups:

        def row(name, values, group=group):
            rows.append(dict(views=group.views, second=group.second, object=name, columns=values))

        complete: Values = {}
        spreads: list[dict] = []
        for name in objects:
            runs = {c.title: _runs(c, name, every) for c in group.columns}
            values = {title: _over(numbers, np.mean) for title, numbers in runs.items()}
            row(name, values)
            planned = [c.title for c in group.columns if c.cell(name) is not None]
            if planned and all(values[title] for title in planned):
                complete[name] = values
                if all(len(runs[title]) > 1 for title in planned):
                    spreads.append({title: _over(numbers, _variance) for title, numbers in runs.items()})
        if complete:
            row(f'mean of {len(complete)}', _columns(complete.values(), np.mean))
        if len(complete) > 1:
            row('standard error', _columns(complete.values(), _standard_error))
        if spreads:
            row('spread over seeds', _columns(spreads, lambda variances: float(np.sqrt(np.mean(variances)))))
        if 'r2' in (c.title for c in group.columns):
            gains = {
                name: {title: _less(v, values['r2']) for title, v in values.items()}
                for name, values in complete.items()
            }
        else:  # of tables whose rows are methods
            base.setdefault(group.views, complete)
            shared = complete.keys() & base[group.views].keys() if complete is not base[group.views] else ()
            gains = {
                name: {t: _less(v, base[group.views][name][t]) for t, v in complete[name].items()}
                for name in sorted(shared)
            }
        if len(gains) > 1:
            row('gain over r2', _columns(gains.values(), np.mean))
            row('its standard error', _columns(gains.values(), _standard_error))
        if any(c.paper for c in group.columns):
            row('paper', {c.title: c.paper and dict(zip(c.fields, c.paper)) for c in group.columns})
    return rows


Values = dict[str, dict[str, 'dict[str, float | None] | None']]  # by object, column and field


def _runs(column: Column, name: str, every: Sequence[Cells]) -> list[dict]:
    """The numbers of an object, one dictionary a seed."""
    if column.published is not None:
        return [{column.fields[0]: column.published[name]}] if name in column.published else []
    if (cell := column.cell(name)) is None:
        return []
    return [{field: numbers[field] for field in column.fields} for cells in every if (numbers := cells.get(cell))]


def _over(dicts: Sequence[dict], function: Callable) -> dict | None:
    """A function of the values of each field; None if a value is missing."""
    if not dicts:
        return None
    fields = {field: [d[field] for d in dicts] for field in dicts[0]}
    return {field: None if None in values else float(function(values)) for field, values in fields.items()}


def _columns(objects: Iterable[dict], function: Callable) -> dict:
    """A function of the values of each column and field; a column that an object lacks is None."""
    objects = list(objects)
    return {
        title: None if any(o[title] is None for o in objects) else _over([o[title] for o in objects], function)
        for title in objects[0]
    }


def _less(a: dict | None, b: dict | None) -> dict | None:
    if a is None or b is None:
        return None
    return {f: None if a[f] is None or b.get(f) is None else a[f] - b[f] for f in a}


def _variance(values: Sequence[float]) -> float:
    return float(np.var(values, ddof=1))


def _standard_error(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))


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


def write(table: str, table_groups: list[Group], objects: Iterable[str], every: Sequence[Cells], name: str) -> str:
    """Write TABLE.json, TABLE.md and TABLE.provenance.json, of the cells that there are, into their folder; returns the Markdown.

    Each cell keeps its own provenance in its own file.

    Parameters
    ----------
    every : Sequence[Cells]
        The cells of each seed.
    name : str
        Name of the scale.
    """
    rows = results(table_groups, objects, every)
    planned = plan(table_groups, objects)
    done = sum(cells.get(cell) is not None for cell in planned for cells in every)
    scale, cells = every[0].scale, every[0]
    for seeded in every:
        seeded.record_all(planned)
    finer = f' (scanned on {scale.finer} times as many)' if scale.finer > 1 else ''
    noise = (
        f'{scale.photons:g} photons a pixel in the open beam, electronic noise of {scale.electronic_noise:g}, '
        f'line integrals up to {scale.longest:g}; '
        if scale.photons
        else ''
    )
    if scale.data:
        scans = 'Scans as they are in their files'
    else:
        scans = f'Scale `{name}`: at most {scale.size} voxels a side{finer}, {scale.pixels} x {scale.pixels} pixels'
    chosen = 'the first views; ' if scale.first else ''
    seeds = f'seed{"s" * (len(every) > 1)} {", ".join(str(seeded.seed) for seeded in every)}'
    text = (
        f'# {TITLES[table]}\n\n{NOTES[table]}\n\n{scans}, {scale.n_points:,} Gaussians to start with '
        f'(`xgaussian`: one on every eighth voxel a side); {chosen}{noise}{seeds}; {done} of '
        f'{len(planned) * len(every)} cells.\n\n{markdown(table, table_groups, rows)}\n'
    )
    cells.folder.mkdir(parents=True, exist_ok=True)
    for kind, content in (('json', json.dumps(rows, indent=1) + '\n'), ('md', text)):
        with replacing(cells.folder / f'{table}.{kind}') as temporary:
            temporary.write_text(content, encoding='utf-8')
    write_provenance(cells.folder / f'{table}.md')
    return text
