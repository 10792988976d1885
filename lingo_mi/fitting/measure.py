"""The numbers of a fit: quality of held-out views and of the volume, IPSD, times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lingo_mi.fitting.fitted_model import FittedModel
from lingo_mi.fitting.lingo_summary import lingo_summary
from lingo_mi.fitting.residual import residual_numbers
from lingo_mi.fitting.stopping import sentence
from lingo_mi.metrics import quality as metrics
from lingo_mi.metrics.ipsd import ipsd, reverse_distance
from lingo_mi.scan import Dataset, Scan


def fit_metrics(fit: FittedModel) -> dict:
    """All numbers of a fit: quality of the held-out views and of the volume, None without a truth; IPSD; times; the history."""
    data, views = fit.data, fit.views
    test = None if data is None else data.test
    volume = fit.scan_volume if fit.method.makes_volume else None
    truth = None if data is None else data.volume
    expected = rendered = None
    if test is not None and views is not None:
        expected, rendered = test.projections, comparable(views, test)

    def of(function, result, reference):
        return None if result is None or reference is None else _number(function(result, reference))

    steps = max(fit.steps + (fit.search['iterations'][-1] if fit.search else 0), 1)  # of the search, too
    return dict(
        psnr_2d=of(metrics.psnr_2d, rendered, expected),
        ssim_2d=of(metrics.ssim_2d, rendered, expected),
        psnr_2d_r2=of(metrics.psnr_2d_r2, rendered, expected),
        ssim_2d_r2=of(metrics.ssim_2d_r2, rendered, expected),
        psnr_3d=of(metrics.psnr_3d, volume, truth),
        ssim_3d=of(metrics.ssim_3d, volume, truth),
        psnr_3d_r2=of(metrics.psnr_3d_r2, volume, truth),
        ssim_3d_r2=of(metrics.ssim_3d_r2, volume, truth),
        **({} if rendered is None or test is None else residual_numbers(rendered, test)),
        **_of_gaussians(fit),
        parameters=sum(v.size for v in fit.state.values.values()),
        iterations=fit.steps,
        seconds_init=fit.info.get('seconds', 0.0),
        seconds_fit=fit.checkpoint.seconds,
        ms_per_iteration=1e3 * fit.checkpoint.seconds / steps,
        history=fit.history,
        **({} if fit.search is None else dict(stopping=sentence(fit.search), search=fit.search)),
        **({} if (lingo := lingo_summary(fit)) is None else dict(lingo=lingo)),
    )


def quick_measure(fit: FittedModel) -> dict:
    """PSNR of the held-out views and of the volume, as far as there is a truth, for the history."""
    numbers, data = {}, fit.data
    if data is not None and data.test is not None and fit.views is not None:
        numbers['psnr_2d'] = _number(metrics.psnr_2d(comparable(fit.views, data.test), data.test.projections))
    if data is not None and data.volume is not None and fit.method.makes_volume:
        numbers['psnr_3d'] = _number(metrics.psnr_3d(fit.scan_volume, data.volume))
        numbers['psnr_3d_r2'] = _number(metrics.psnr_3d_r2(fit.scan_volume, data.volume))
    return numbers


def few_views(dataset: Dataset, most: int = 4) -> Dataset:
    """The data set with few of its held-out views, evenly chosen, for measurements on the way."""
    test = dataset.test
    if test is None or len(test) <= most:
        return dataset
    return replace(dataset, test=test.subset(np.arange(most) * len(test) // most))


def _of_gaussians(fit: FittedModel) -> dict:
    """The numbers of a cloud; a neural field has none."""
    if not fit.method.makes_gaussians:
        return dict(ipsd=None, ipsd_targets=0, ipsd_reverse=None, gaussians=0)
    initial, born = fit.checkpoint.arrays['initial'], fit.state.values['centre'][fit.state.born]
    return dict(
        ipsd=_number(ipsd(initial, born)),
        ipsd_targets=len(born),
        ipsd_reverse=_number(reverse_distance(initial, born)),
        gaussians=len(fit.state),
    )


def summary(result: dict) -> str:
    """The main numbers of a result, one line each."""
    return '\n'.join(
        [
            *_view_quality(result),
            *([volume_quality(result)] if _any(result, 'psnr_3d', 'ssim_3d') else []),
            f'{_fitted_to(result)} after {result["iterations"]} iterations of '
            f'{result["ms_per_iteration"]:.0f} ms: {result["seconds_init"]:.1f} s to start, '
            f'{result["seconds_fit"]:.0f} s to fit',
            *([f'                {result["stopping"]}'] if 'stopping' in result else []),
            *([f'LINGO           {result["lingo"]}'] if 'lingo' in result else []),
        ]
    )


def _view_quality(result: dict) -> list[str]:
    """Describe in lines how well held-out views are predicted."""
    lines = []
    if _any(result, 'psnr_2d', 'ssim_2d'):
        lines.append(f'held-out views  {_shown(result, "psnr_2d", "ssim_2d")}')
    if (rms := result.get('residual_rms')) is not None:
        noise = result.get('residual_to_noise')
        times = '' if noise is None else f', {noise:.2f} times the noise of their pixels'
        lines.append(f'                residual {rms:.3g} rms{times}')
    return lines


def _fitted_to(result: dict) -> str:
    """Return the first words of the line: the model that was fitted, and its size."""
    if result['gaussians']:
        return f'cloud           {result["gaussians"]:,} Gaussians'
    return f'neural field    {result["parameters"]:,} parameters'


def volume_quality(result: dict) -> str:
    """A volume's numbers as lines: first for densities in any unit, then R2-Gaussian's, for densities up to 1."""
    return (
        f'volume          {_shown(result, "psnr_3d", "ssim_3d")} (full scale: the largest true density)\n'
        f'                {_shown(result, "psnr_3d_r2", "ssim_3d_r2")} (full scale: 1, as in R2-Gaussian)'
    )


def comparable(rendered: np.ndarray, test: Scan) -> np.ndarray:
    """Rendered views [view, v, u] with invalid pixels at zero, as in the scan."""
    return rendered if test.valid is None else np.where(test.valid, rendered, np.float32(0))


def _number(x: float):
    """A number for JSON, or None for NaN and infinity, which JSON does not have."""
    return x if np.isfinite(x) else None


def _any(result: dict, *names: str) -> bool:
    return any(result[name] is not None for name in names)


def _shown(result: dict, psnr: str, ssim: str) -> str:
    formats = (('PSNR', psnr, '{:.2f} dB'), ('SSIM', ssim, '{:.4f}'))
    return ', '.join(f'{name} {form.format(result[key])}' for name, key, form in formats if result[key] is not None)
