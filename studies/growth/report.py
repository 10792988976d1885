"""The figure and the table of how cost grows."""

from __future__ import annotations

from pathlib import Path

from lingo_mi.storage.file_access import replacing
from lingo_mi.validation.markdown import table
from studies.growth.stages import AXES, DEPENDS
from studies.growth.sweep import exponent


def rows_of(rows: list[dict], stage: str, axis: str) -> list[dict]:
    """The measurements of a stage along an axis, by number."""
    return sorted((r for r in rows if (r['stage'], r['axis']) == (stage, axis)), key=lambda row: row['number'])


def exponents(measured: list[dict]) -> str:
    """Markdown: the exponent of CPU time by stage and axis; "–" marks no dependence."""

    def cell(axis):
        def text(row):
            rows = rows_of(measured, row['stage'], axis)
            return f'{exponent(rows, "seconds"):.2f}' if len(rows) > 1 else '–'

        return text

    columns = [('stage', lambda row: row['stage']), *((axis, cell(axis)) for axis in AXES)]
    return table(columns, [dict(stage=stage) for stage in DEPENDS])


def draw(measured: list[dict], path: Path) -> None:
    """CPU seconds (above) and peak memory (below) of every stage against voxels, pixels, views and Gaussians."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=(15, 8), layout='constrained')
    axes = fig.subplots(2, len(AXES), sharex='col', sharey='row')
    for column, axis in enumerate(AXES):
        for i, stage in enumerate(DEPENDS):
            rows = rows_of(measured, stage, axis)
            if len(rows) < 2:
                continue
            numbers = [row['number'] for row in rows]
            for line, (key, unit) in enumerate((('seconds', 1), ('peak', 1e9))):
                values = [max(row[key] / unit, 1e-3) for row in rows]
                # Small arrays fit into memory that a process has already: their memory follows no law.
                label = f'{stage}: {exponent(rows, key):.2f}' if key == 'seconds' else stage
                axes[line, column].loglog(numbers, values, 'o-', color=f'C{i}', label=label, markersize=4)
        axes[1, column].set_xlabel(axis)
        for line in range(2):
            axes[line, column].grid(alpha=0.3)
            title = None if line else 'exponent of the last factor of ten'
            axes[line, column].legend(fontsize=7, title=title, title_fontsize=7)
    axes[0, 0].set_ylabel('CPU time of a call [s]')
    axes[1, 0].set_ylabel('peak memory [GB]')
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        fig.savefig(temporary, dpi=80)
