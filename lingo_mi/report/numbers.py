"""The numbers of a result as text, and one plain line about each."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


class Number(NamedTuple):
    """Presentation of a number: its label, unit, format and meaning."""

    label: str
    unit: str
    form: str
    meaning: str


# The absolute forms first, whose full scale is the largest true value; then R2-Gaussian's.
QUALITY = {
    'psnr_3d': Number(
        "PSNR 3D, peak the truth's maximum", 'dB', '.2f',
        'Mean squared error of the volume against the largest true density, on a logarithmic scale. More is better.',
    ),
    'ssim_3d': Number(
        "SSIM 3D, windows of 11 x 11 x 11 voxels, the truth's maximum as full scale", '', '.4f',
        'How alike the structures of volume and truth are, from small windows; 1 is identical.',
    ),
    'psnr_2d': Number(
        'PSNR 2D, held-out views as they are', 'dB', '.2f',
        'Mean squared error of views that the fit has never seen, against the largest line integral in them. More is better.',
    ),
    'ssim_2d': Number(
        'SSIM 2D, held-out views as they are', '', '.4f',
        'How alike rendered and given held-out views are; 1 is identical.',
    ),
    'residual_rms': Number(
        'Residual of the held-out views, rms', '', '.4g',
        'Rendered minus given line integrals, over all pixels of views that the fit has never seen. Less is better.',
    ),
    'residual_to_noise': Number(
        'Residual of the held-out views over their noise', '', '.2f',
        '1 would be noise alone. The noise is estimated from how neighbouring pixels scatter.',
    ),
    'psnr_3d_r2': Number(
        'PSNR 3D as in R2-Gaussian: peak 1', 'dB', '.2f',
        'To compare with published tables. Only for densities that reach 1: a dim object looks better than it is.',
    ),
    'ssim_3d_r2': Number(
        'SSIM 3D as in R2-Gaussian: mean over the slices of the three axes, full scale 1', '', '.4f',
        'To compare with published tables; the same caution.',
    ),
    'psnr_2d_r2': Number(
        'PSNR 2D as in R2-Gaussian: each view divided by its own maximum', 'dB', '.2f',
        'To compare with published tables.',
    ),
    'ssim_2d_r2': Number(
        'SSIM 2D as in R2-Gaussian: each view divided by its own maximum', '', '.4f',
        'To compare with published tables.',
    ),
    'ipsd': Number(
        'IPSD: mean distance between Gaussians born in the fit and initial points (longest side of the volume = 2)',
        '', '.4f',
        'How far new Gaussians lie from the start. Less means that the start was where Gaussians were needed.',
    ),
    'ipsd_targets': Number(
        'Gaussians born in the fit that IPSD counts', '', ',d', 'How many Gaussians that mean is of.'
    ),
    'ipsd_reverse': Number(
        'Mean distance of initial points to Gaussians born in the fit', '', '.4f', 'The same, seen from the initial points.'
    ),
    'gaussians': Number('Gaussians', '', ',d', 'The size of the cloud at the end.'),
    'parameters': Number('Parameters', '', ',d', 'Numbers that the fit adjusts.'),
    'seconds_init': Number('Time to initialise', 's', '.2f', 'From projections to the initial cloud.'),
    'seconds_fit': Number('Time to fit', 's', '.1f', 'All steps, without the measurements in between.'),
    'ms_per_iteration': Number(
        'Time per iteration', 'ms', '.2f', 'The time to fit, divided by the iterations, including a search.'
    ),
}  # fmt: skip
SETTINGS = {
    'method': Number('Method', '', '', 'The method of a fit, or the algorithm of a reconstruction.'),
    'views': Number('Views used', '', '', 'Measured projections that the result was made of.'),
    'held_out': Number(
        'Views held out',
        '',
        '',
        'Not fitted, to measure how well such views are predicted. hold_out=0, or --hold-out 0, fits them, too.',
    ),
    'iterations': Number('Iterations', '', ',d', 'Steps of the optimiser, one batch of views each.'),
    'stopping': Number(
        'Early stop', '', '', 'The step after which more steps no longer improved the prediction of held-out views.'
    ),
    'lingo': Number(
        "LINGO's parts",
        '',
        '',
        'Otsu masks, and the voxels in the masks of all views, in which Gaussians start; the factor on the loss.',
    ),
    'seed': Number('Seed', '', '', 'Of every random choice; the same seed gives the same result.'),
    'variant': Number('Mitsuba variant', '', '', 'CPU or GPU.'),
    'versions': Number('Versions', '', '', 'The software that computed this result.'),
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
LISTED = {
    'history',
    'residual_by_view',
    'search',
    'files',
    'settings',
    'initial',
    'angles',
    'test_angles',
    'command',
}  # shown in other ways


def headline(metrics: dict) -> str:
    """The main numbers with units on one line, without missing ones and NaN."""
    shown = [(text, key) for key, text in HEADLINE.items() if has_value(metrics.get(key))]
    return '   ·   '.join(text.format(as_text(key, metrics[key])) for text, key in shown)


def has_value(value: object) -> bool:
    """Return whether there is something to show: neither None nor NaN."""
    return not (value is None or isinstance(value, (float, np.floating)) and math.isnan(value))


def as_text(key: str, value: object) -> str:
    """A number as text with its unit; what is missing or NaN as a dash."""
    if isinstance(value, dict):
        return ', '.join(f'{k} {as_text("", v)}' for k, v in value.items())
    if isinstance(value, (list, tuple, np.ndarray)):
        return ', '.join(as_text('', v) for v in value)
    if not has_value(value):
        return '–'
    number = QUALITY.get(key) or SETTINGS.get(key)
    unit, form = (number.unit, number.form) if number else ('', '')
    if isinstance(value, (bool, str)):
        return str(value)
    if form:
        value = int(value) if form.endswith('d') else float(value)  # pyright: ignore[reportArgumentType]
    elif isinstance(value, (float, np.floating)):
        form = '.6g'
    text = '∞' if value == math.inf else format(value, form)
    return f'{text} {unit}' if unit else text
