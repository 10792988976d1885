"""The report of a result: a picture (report.png) and a page (report.html) that holds all it shows."""

from __future__ import annotations

import io
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.report import figures, template
from lingo_mi.report.data import ReportData
from lingo_mi.report.numbers import LISTED, QUALITY, SETTINGS, as_text, has_value, headline
from lingo_mi.report.payload import colour_maps, history, payload
from lingo_mi.storage.file_access import replacing, write_text
from lingo_mi.storage.output_folder import PAGE, PICTURE


def write_report(folder: PathLike | str, data: ReportData) -> Path:
    """Write report.png and report.html into `folder`, which is created if missing. Returns the path of report.html.

    The page embeds all it shows and loads nothing, so it can be mailed or opened without a network.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # Both are made before either is written, so that there are both or neither.
    picture, page = figures.overview(data, headline(data.metrics)), report_page(data)
    with replacing(folder / PICTURE) as temporary:
        temporary.write_bytes(picture)
    write_text(folder / PAGE, page)
    return folder / PAGE


def report_page(data: ReportData) -> str:
    """The page of a report, as text."""
    content, arrays = payload(data)
    content |= dict(colours=colour_maps(), history=history(data.history))
    command = template.code('Make it again', data.command) if data.command else ''
    return template.page(data.title, headline(data.metrics), _scanner(data) + _numbers(data), command, content, arrays)


def _scanner(data: ReportData) -> str:
    """The scanner of the fitted views, to scale."""
    if data.scanner is None:
        return ''
    png = io.BytesIO()
    data.scanner.show().savefig(png, format='png', dpi=80)
    return template.picture('Scanner', png.getvalue(), 'The scanner from above and from the side, to scale.') + '\n'


def _numbers(data: ReportData) -> str:
    metrics = {key: value for key, value in data.metrics.items() if has_value(value)}
    quality = [(n.label, as_text(key, metrics[key]), n.meaning) for key, n in QUALITY.items() if key in metrics]
    settings = [(n.label, as_text(key, metrics[key]), n.meaning) for key, n in SETTINGS.items() if key in metrics]
    size = ' x '.join(str(n) for n in data.shape or ())
    voxels = f'{size} voxels of {" x ".join(f"{s:.4g}" for s in data.spacing)} mm'
    grid = 'The grid that the density is given on.'
    if data.volume is None:
        grid = 'Opacities and radiances are not attenuation: this cloud makes no volume, and no scene renders it.'
    settings.append(('Volume', voxels, grid))
    others = [
        (key, as_text(key, value), '')
        for key, value in metrics.items()
        if key not in {*QUALITY, *SETTINGS, *LISTED} and np.ndim(value) == 0 and not isinstance(value, dict)
    ]
    out = [template.html_table('Quality and cost', quality, 'numbers')] if quality else []
    out.append(template.html_table('What was done', settings + others, 'numbers'))
    more = {}
    for key, title in (('settings', 'All settings of the fit'), ('initial', 'The initial cloud')):
        if isinstance(metrics.get(key), dict):
            more[title] = [(str(k), as_text('', v)) for k, v in metrics[key].items()]
    for key, title in (('angles', 'Angles of the fitted views'), ('test_angles', 'Angles of the held-out views')):
        if key in metrics and len(metrics[key]):
            more[title] = [(f'{len(metrics[key])} views', ', '.join(f'{angle:.5g}°' for angle in metrics[key]))]
    return '\n'.join([*out, template.folded('More', more)] if more else out)
