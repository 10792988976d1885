"""Every view of a scan predicted from views other than itself, by quick reconstructions on few voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from lingo_mi.geometry import Geometry, Grid
from lingo_mi.reconstruction.sart import blocks, sweep
from lingo_mi.reconstruction.system import System
from lingo_mi.scan import Scan

PASSES = 4  # over the views: fewer leave edges and peaks too low, as if the detector had a curve
RELAXATION = 1.0
SMOOTH = 0.8  # standard deviation in pixels: so smooth that a shift by part of a pixel smooths no further
BEYOND = 4  # pixels of a row or a column that smoothing adds to either end
EDGE = 0.15  # of the highest value: if the panel's edge has more, the object goes on beyond it
WIDER, MARGIN = 1.5, 1.15  # factors on the volume then, and otherwise: a panel that moves, moves the object


def coarse(scan: Scan, pixels: int) -> Scan:
    """The scan binned to about `pixels` columns and smoothed, on voxels as wide as a pixel at the axis.

    If the object reaches over the panel's edge, the volume is wider, so that there is room for what lies beyond.
    """
    small = _binned(scan, max(1, round(max(scan.geometry.nDetector) / pixels)))
    g = small.geometry
    at_axis = g.DSO / g.DSD if g.mode == 'cone' else 1.0
    step = max(g.dDetector[1] * at_axis, min(g.grid.spacing[:2]))
    highest = np.percentile(small.projections, 99.5)
    sides = [small.projections[:, :, [0, -1]], small.projections[:, [0, -1], :]]
    cut = [g.nDetector[k] > 2 and np.percentile(p, 95) > EDGE * highest for k, p in ((1, sides[0]), (0, sides[1]))]
    size = np.array(g.grid.size) * np.where([cut[0], cut[0], cut[1]], WIDER, MARGIN)
    if g.mode == 'cone':  # the source stays outside
        size[:2] = np.minimum(size[:2], max(1.3 * g.DSO, min(g.grid.size[:2])))
    count = np.maximum(np.ceil(size / step), 1).astype(int)
    voxel = [step] * 3
    if g.grid.shape[2] == 1:
        count[2], voxel[2] = 1, g.grid.spacing[2]
    return replace(small.on(Grid(count, voxel, g.grid.centre)), projections=_smoothed(small))


def _binned(scan: Scan, factor: int) -> Scan:
    """The scan binned by the means of valid pixels; a new pixel is valid if half of its pixels are."""
    if scan.valid is None:
        return scan.binned(factor)
    valid = scan.valid.astype(np.float32)
    sums, share = (replace(scan, projections=p, valid=None).binned(factor) for p in (scan.projections * valid, valid))
    half_valid = share.projections >= 0.5
    return replace(sums, projections=sums.projections / np.maximum(share.projections, 0.5), valid=half_valid)


def _smoothed(scan):
    """The projections, each pixel a weighted mean of valid ones.

    A slope goes on beyond the panel's edge: if the object reaches over it, anything else would be taken for a shift.
    """
    valid = np.ones(scan.projections.shape, np.float32) if scan.valid is None else scan.valid.astype(np.float32)
    by = [0.0, *(SMOOTH if n > 2 else 0.0 for n in scan.geometry.nDetector)]
    beyond = [(0, 0), *((min(BEYOND, n - 1) if n > 2 else 0,) * 2 for n in scan.geometry.nDetector)]
    inside = tuple(slice(k, k + n) for (k, _), n in zip(beyond, scan.projections.shape))
    weight = np.pad(valid, beyond, 'reflect')
    wider = np.pad(scan.projections, beyond, 'reflect', reflect_type='odd') * weight
    values, weights = (ndimage.gaussian_filter(x, by, mode='nearest')[inside] for x in (wider, weight))
    return values / np.maximum(weights, 1e-3)


@dataclass(frozen=True)
class Fold:
    """Views that are predicted from all others, and the blocks in which a reconstruction takes those. View numbers."""

    predicted: np.ndarray
    blocks: list[np.ndarray]


def folds_of(geometry: Geometry) -> list[Fold]:
    """Views in turns around the circle: two groups of many views, three of few."""
    angles, n = geometry.angles, len(geometry)
    order = np.argsort(np.mod(angles, 2 * np.pi), kind='stable')
    groups = 2 if n >= 48 else 3
    folds = []
    for k in range(groups):
        fold = np.sort(order[k::groups])
        others = np.setdiff1d(np.arange(n), fold)
        turns = blocks(angles[others], max(1, len(others) // 20), 'angularDistance', np.random.default_rng(0))
        folds.append(Fold(fold, [others[turn] for turn in turns]))
    return folds


def cross_predicted(scan: Scan, folds: Sequence[Fold]) -> np.ndarray:
    """Line integrals [view, v, u] of every view, from a reconstruction of the views outside its fold."""
    system = System(scan)
    out = np.empty((len(scan), *scan.geometry.nDetector[::-1]), np.float32)
    for fold in folds:
        x = system.start(None)
        for _ in range(PASSES):
            x = sweep(system, x, RELAXATION, fold.blocks, True)
        views = fold.predicted
        out[views] = system.A.forward(x, views)[0].numpy().reshape(len(views), *out.shape[1:])
    return out.transpose(0, 2, 1)
