"""The cost of accuracy: error, time and memory of all ways to compute the same projections, and of fits.

`measure` runs everything with fixed seeds in this process and returns plain numbers. `report.write` makes tables and plots.

    report.write(measure(QUICK), Path('out/accuracy'), figures=Path('out/accuracy'))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.cutoff import PRESETS
from lingo_mi.validation.accuracy import field, fits, images, scaling
from lingo_mi.validation.accuracy.sizes import FULL, QUICK, Sizes
from lingo_mi.validation.accuracy.workload import Workload
from lingo_mi.validation.provenance import machine

__all__ = ['FULL', 'QUICK', 'Sizes', 'measure', 'measure_presets']


def measure(sizes: Sizes, progress: Callable[[str], object] | None = None) -> dict:
    """All measurements, as numbers and strings for JSON.

    Parameters
    ----------
    progress : callable or None
        Called as progress(what) before each part.
    """
    work, few = (Workload(n, sizes.pixels, sizes.box) for n in (sizes.gaussians, sizes.few))
    parts = dict(
        cutoff=lambda: images.cutoff(work, sizes),
        footprint=lambda: images.footprint(work, sizes),
        methods=lambda: images.methods(few, sizes),
        marching=lambda: images.marching(few, sizes),
        pixel=lambda: images.pixel(sizes),
        teams=lambda: images.teams(work, sizes),
        scaling=lambda: scaling.sweeps(sizes),
        initialisations=lambda: fits.initialisations(sizes),
        fits=lambda: fits.curves(sizes),
        field=lambda: field.samples(sizes),
    )
    out: dict = dict(conditions=_conditions(sizes))
    for name, part in parts.items():
        if progress:
            progress(name)
        out[name] = part()
    return out


def measure_presets(sizes: Sizes) -> dict:
    """Return the conditions and the presets' cut-offs of `measure`, which need no ray tracing."""
    work = Workload(sizes.gaussians, sizes.pixels, sizes.box)
    return dict(conditions=_conditions(sizes), cutoff=images.cutoff(work, sizes, PRESETS.values()))


def _conditions(sizes: Sizes) -> dict:
    return dict(variant=mi.variant(), threads=dr.thread_count(), machine=machine(), sizes=asdict(sizes))
