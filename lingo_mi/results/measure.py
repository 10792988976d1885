"""The numbers of a fit: quality of held-out views and of the volume, IPSD, times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lingo_mi.fitting.fitted import Fitted
from lingo_mi.metrics import quality as metrics
from lingo_mi.metrics.ipsd import ipsd, reverse_distance
from lingo_mi.results.watch import Snapshot
from lingo_mi.scan import Dataset, Scan


def quick_measure(
    dataset: Dataset, most: int = 4, look: Callable[[Snapshot], None] | None = None
) -> Callable[..., dict]:
    """A function for `fitting.loop.run` that gives 2D PSNR on up to `most` held-out views, and 3D PSNR where there is a truth.

    look   is shown the state, with what was rendered to measure it
    """
    test = dataset.test
    if test is not None and len(test) > most:
        test = test.subset(np.arange(most) * len(test) // most)

    def measure(model, state):
        out, rendered, pair = {}, None, None
        if test is not None and len(test):
            rendered = comparable(model.expected(state, test.geometry), test)
            out['psnr_2d'] = _number(metrics.psnr_2d(rendered, test.projections))
        if dataset.volume is not None and (volume := model.volume(state)) is not None:
            out['psnr_3d'] = _number(metrics.psnr_3d(volume, dataset.volume))
            out['psnr_3d_r2'] = _number(metrics.psnr_3d_r2(volume, dataset.volume))
            pair = volume, dataset.volume
        if look is not None:
            look(Snapshot(model, state, test, rendered, pair, dict(out)))
        return out

    return measure


@dataclass(frozen=True)
class Measured:
    """A finished fit, measured.

    numbers   by name; None if there is no truth to compare with
    volume    float32 [x, y, z], density per mm; None for alpha compositing
    truth     the true volume; None if unknown
    test      held-out views; None if there are none
    views     the same views, rendered from the fit, float32 [view, v, u]
    """

    numbers: dict
    volume: np.ndarray | None = None
    truth: np.ndarray | None = None
    test: Scan | None = None
    views: np.ndarray | None = None


def measure(fitted: Fitted, test: Scan | None = None, truth: np.ndarray | None = None) -> Measured:
    """Measure a finished fit: its volume, its held-out views and its numbers.

    test    held-out views
    truth   the true density in 1/mm, [x, y, z], on the grid of the fit's geometry
    """
    test = test if test is not None and len(test) else None
    volume, views = fitted.volume(), None if test is None else fitted.expected(test.geometry)
    expected = None if test is None else test.projections
    rendered = None if test is None or views is None else comparable(views, test)

    def of(function, result, reference):
        return None if result is None or reference is None else _number(function(result, reference))

    numbers = dict(
        psnr_2d=of(metrics.psnr_2d, rendered, expected),
        ssim_2d=of(metrics.ssim_2d, rendered, expected),
        psnr_2d_r2=of(metrics.psnr_2d_r2, rendered, expected),
        ssim_2d_r2=of(metrics.ssim_2d_r2, rendered, expected),
        psnr_3d=of(metrics.psnr_3d, volume, truth),
        ssim_3d=of(metrics.ssim_3d, volume, truth),
        psnr_3d_r2=of(metrics.psnr_3d_r2, volume, truth),
        ssim_3d_r2=of(metrics.ssim_3d_r2, volume, truth),
        **_of_gaussians(fitted),
        parameters=sum(v.size for v in fitted.state.values.values()),
        iterations=fitted.steps,
        seconds_init=fitted.info.get('seconds', 0.0),
        seconds_fit=fitted.seconds,
        ms_per_iteration=1e3 * fitted.seconds / _steps_made(fitted),
        history=fitted.history,
        **({} if fitted.search is None else dict(stopping=fitted.search['said'], search=fitted.search)),
    )
    return Measured(numbers, volume, truth, test, views)


def _of_gaussians(fitted: Fitted) -> dict:
    """The numbers of a cloud; a neural field has none."""
    if not fitted.settings.cloud:
        return dict(ipsd=None, ipsd_targets=0, ipsd_reverse=None, gaussians=0)
    born = fitted.state.values['centre'][fitted.state.born]
    return dict(
        ipsd=_number(ipsd(fitted.initial, born)),
        ipsd_targets=len(born),
        ipsd_reverse=_number(reverse_distance(fitted.initial, born)),
        gaussians=len(fitted.state),
    )


def _steps_made(fitted: Fitted) -> int:
    """Steps of the fit and of the search before it."""
    return max(fitted.steps + (fitted.search['iterations'][-1] if fitted.search else 0), 1)


def summary(result: dict) -> str:
    """The main numbers of a result, one line each."""
    return '\n'.join(
        [
            f'held-out views  {_shown(result, "psnr_2d", "ssim_2d")}',
            volume_quality(result),
            f'{fitted_to(result)} after {result["iterations"]} iterations of '
            f'{result["ms_per_iteration"]:.0f} ms: {result["seconds_init"]:.1f} s to start, '
            f'{result["seconds_fit"]:.0f} s to fit',
            *([f'                {result["stopping"]}'] if 'stopping' in result else []),
        ]
    )


def fitted_to(result: dict) -> str:
    """What was fitted, of what size: the first words of its line."""
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


def _shown(result: dict, psnr: str, ssim: str) -> str:
    psnr, ssim = (
        'n/a' if result[name] is None else form.format(result[name])
        for name, form in ((psnr, '{:.2f} dB'), (ssim, '{:.4f}'))
    )
    return f'PSNR {psnr}, SSIM {ssim}'
