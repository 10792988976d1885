"""The report of a reconstruction: a picture (report.png) and a self-contained page (report.html)."""

from __future__ import annotations

import base64
import html
import math
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.errors import InputError, brief
from lingo_mi.file_access import replacing, write_text
from lingo_mi.output_folder import PAGE, PICTURE
from lingo_mi.report import figures

# Key of `ReportData.metrics`: label, unit, format.
QUALITY = {
    'psnr_3d': ("PSNR 3D, peak the truth's maximum", 'dB', '.2f'),
    'ssim_3d': ("SSIM 3D, windows of 11 x 11 x 11 voxels, the truth's maximum as full scale", '', '.4f'),
    'psnr_3d_r2': ('PSNR 3D as in R2-Gaussian: peak 1', 'dB', '.2f'),
    'ssim_3d_r2': ('SSIM 3D as in R2-Gaussian: mean over the slices of the three axes, full scale 1', '', '.4f'),
    'psnr_2d': ('PSNR 2D, held-out views as they are', 'dB', '.2f'),
    'ssim_2d': ('SSIM 2D, held-out views as they are', '', '.4f'),
    'psnr_2d_r2': ('PSNR 2D as in R2-Gaussian: each view divided by its own maximum', 'dB', '.2f'),
    'ssim_2d_r2': ('SSIM 2D as in R2-Gaussian: each view divided by its own maximum', '', '.4f'),
    'ipsd': (
        'IPSD: mean distance between Gaussians born in the fit and initial points (longest side of the volume = 2)',
        '',
        '.4f',
    ),
    'ipsd_targets': ('Gaussians born in the fit that IPSD counts', '', ',d'),
    'gaussians': ('Gaussians', '', ',d'),
    'seconds_init': ('Time to initialise', 's', '.2f'),
    'seconds_fit': ('Time to fit', 's', '.1f'),
    'ms_per_iteration': ('Time per iteration', 'ms', '.2f'),
}
SETTINGS = {
    'method': 'Method',
    'views': 'Views used',
    'iterations': 'Iterations',
    'seed': 'Seed',
    'variant': 'Mitsuba variant',
    'versions': 'Versions',
}
HEADLINE = {
    'psnr_3d': 'PSNR 3D {}',
    'ssim_3d': 'SSIM 3D {}',
    'psnr_2d': 'PSNR 2D {}',
    'ssim_2d': 'SSIM 2D {}',
    'gaussians': '{} Gaussians',
    'iterations': '{} iterations',
    'seconds_fit': 'fit {}',
}


@dataclass(frozen=True, eq=False)
class ReportData:
    """The contents of a report. Only `title`, `metrics`, `volume` (or `shape`) and `spacing` are needed.

    title           of the report: any text, shown as it is, on one line of printable characters
    metrics         the numbers, by the keys of QUALITY and SETTINGS. None and NaN are shown as 'n/a'; other scalar
                    entries are listed with the settings. `history` is a list of dicts with `iteration`,
                    `seconds`, `loss`, `psnr_2d`, `psnr_3d` and `gaussians`, each of which may be missing or None
    volume          [x, y, z] density, 1/mm; None for a cloud without densities
    shape           its voxels, (x, y, z); by default those of `volume`
    spacing         voxel size, (x, y, z), mm
    truth           the true volume, as `volume`; None for measured data
    centre          of the volume, (x, y, z), mm
    views           [n, v, u] rendered held-out views: line integrals ln(I0/I)
    views_truth     [n, v, u] the same views as measured, or None
    views_angles    [n] degrees
    pixel           size of a detector pixel, (v, u), mm
    cloud_centres   [N, 3] centres of the Gaussians, mm
    cloud_density   [N] density at their centres, 1/mm, or the quantity that `cloud_unit` names
    command         the command line that reproduces this result

    Raises InputError if shapes do not fit or an image holds NaN or infinity.
    """

    title: str
    metrics: dict
    volume: np.ndarray | None
    spacing: tuple[float, float, float]
    truth: np.ndarray | None = None
    shape: tuple[int, int, int] | None = None
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    views: np.ndarray | None = None
    views_truth: np.ndarray | None = None
    views_angles: np.ndarray | None = None
    pixel: tuple[float, float] = (1.0, 1.0)
    cloud_centres: np.ndarray | None = None
    cloud_density: np.ndarray | None = None
    cloud_unit: str = 'density at the centre [1/mm]'
    command: str = ''
    history: list[dict] = field(init=False)

    def __post_init__(self):
        def fix(name, shape):
            value = getattr(self, name)
            if value is None:
                if name in ('views_angles', 'cloud_density'):
                    raise InputError(f'the report needs {name} of the shape {shape}')
                return
            value = np.asarray(value)
            if value.dtype not in (np.float32, np.float64):
                value = value.astype(float)
            if value.ndim != len(shape) or any(s is not None and n != s for n, s in zip(value.shape, shape)):
                wanted = tuple('n' if s is None else s for s in shape)
                raise InputError(f'{name} of the report has the shape {value.shape}, not {wanted}')
            if not np.isfinite(value).all():
                raise InputError(f'{name} of the report contains NaN or infinity')
            object.__setattr__(self, name, value)

        if self.volume is None and self.shape is None:
            raise InputError('the report needs a volume, or its shape')
        fix('volume', (None,) * 3)
        if self.volume is not None:
            object.__setattr__(self, 'shape', self.volume.shape)
            fix('truth', self.volume.shape)
        for name, n in (('spacing', 3), ('centre', 3), ('pixel', 2)):
            fix(name, (n,))
        fix('views', (None,) * 3)
        if self.views is not None:
            fix('views_truth', self.views.shape)
            fix('views_angles', (len(self.views),))
        fix('cloud_centres', (None, 3))
        if self.cloud_centres is not None:
            fix('cloud_density', (len(self.cloud_centres),))
        for name in ('volume', 'views'):
            if getattr(self, name) is not None and getattr(self, name).size == 0:
                raise InputError(f'{name} of the report is empty')
        object.__setattr__(self, 'title', brief(self.title, 120))
        object.__setattr__(self, 'history', list(self.metrics.get('history') or []))


def write_report(folder: PathLike | str, data: ReportData) -> Path:
    """Write report.png and report.html into `folder`, which is created if missing. Returns the path of report.html.

    The page embeds its pictures and loads nothing, so it can be mailed or opened without a network.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # Both are made before either is written, so that there are both or neither.
    picture, page = figures.overview(data, headline(data.metrics)), _page(data)
    with replacing(folder / PICTURE) as temporary:
        temporary.write_bytes(picture)
    write_text(folder / PAGE, page)
    return folder / PAGE


def headline(metrics: dict) -> str:
    """The main numbers with units on one line, without missing ones and NaN."""
    shown = [(text, _value(key, metrics.get(key))) for key, text in HEADLINE.items()]
    return '   ·   '.join(text.format(value) for text, value in shown if value != 'n/a')


def _value(key, value) -> str:
    """A number as text with its unit."""
    if isinstance(value, dict):
        return ', '.join(f'{k} {v}' for k, v in value.items())
    if isinstance(value, (list, tuple, np.ndarray)):
        return ', '.join(_value('', v) for v in value)
    if value is None or isinstance(value, (float, np.floating)) and math.isnan(value):
        return 'n/a'
    unit, form = QUALITY[key][1:] if key in QUALITY else ('', '')
    if isinstance(value, (bool, str)):
        return str(value)
    if form:
        value = int(value) if form.endswith('d') else float(value)
    elif isinstance(value, (float, np.floating)):
        form = '.6g'
    elif key == 'iterations':
        form = ',d'
    text = '∞' if value == math.inf else format(value, form)
    return f'{text} {unit}' if unit else text


STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #f4f5f7; margin: 0; }
main { max-width: 1100px; margin: 0 auto; padding: 2rem 1.5rem 3rem; }
h1 { margin: 0; font-size: 1.9rem; } h2 { margin: 0 0 .6rem; font-size: 1.2rem; }
.headline { color: #555; margin: .3rem 0 1.5rem; }
section { background: #fff; border: 1px solid #dde0e5; border-radius: 8px; padding: 1.2rem 1.4rem;
  margin-bottom: 1.2rem; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(380px, 1fr)); gap: 1.2rem; }
.pair section { margin-bottom: 0; } .pair { margin-bottom: 1.2rem; }
table { border-collapse: collapse; width: 100%; font-size: .93rem; }
th, td { text-align: left; padding: .32rem .4rem; border-bottom: 1px solid #eceef1; vertical-align: top; }
th { font-weight: normal; color: #555; } td { font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.numbers td { text-align: right; white-space: nowrap; }
img { width: 100%; height: auto; display: block; } figure { margin: 0; }
figcaption { color: #555; font-size: .92rem; margin-top: .6rem; }
pre { background: #f4f5f7; padding: .8rem; border-radius: 6px; white-space: pre-wrap;
  overflow-wrap: anywhere; margin: 0; }
"""


def _page(data: ReportData) -> str:
    text = html.escape
    metrics = data.metrics
    quality = [(label, _value(key, metrics[key])) for key, (label, *_) in QUALITY.items() if key in metrics]
    settings = [(label, _value(key, metrics[key])) for key, label in SETTINGS.items() if key in metrics]
    size = ' x '.join(str(n) for n in data.shape or ())
    settings.append(('Volume', f'{size} voxels of {" x ".join(f"{s:.4g}" for s in data.spacing)} mm'))
    known = {*QUALITY, *SETTINGS, 'history'}
    settings += [
        (key, _value(key, value))
        for key, value in metrics.items()
        if key not in known and np.ndim(value) == 0 and not isinstance(value, dict)
    ]

    body = [
        '<div class="pair">',
        _table('Quality and cost', quality, 'numbers'),
        _table('Settings', settings, 'settings'),
        '</div>',
    ]
    for section in figures.sections(data):
        embedded = base64.b64encode(figures.sheet(data, section)).decode('ascii')
        body.append(
            f'<section><h2>{text(section.name)}</h2><figure>'
            f'<img alt="{text(section.name)}" src="data:image/png;base64,{embedded}">'
            f'<figcaption>{text(section.caption)}</figcaption></figure></section>'
        )
    if data.command:
        body.append(f'<section><h2>Make it again</h2><pre>{text(data.command)}</pre></section>')
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width"><title>{text(data.title)}</title>'
        f'<style>{STYLE}</style></head>\n<body><main><h1>{text(data.title)}</h1>'
        f'<p class="headline">{text(headline(metrics))}</p>\n' + '\n'.join(body) + '\n</main></body></html>\n'
    )


def _table(title, rows, kind):
    cells = ''.join(f'<tr><th>{html.escape(a)}</th><td>{html.escape(b)}</td></tr>' for a, b in rows)
    return f'<section><h2>{title}</h2><table class="{kind}">{cells}</table></section>'
