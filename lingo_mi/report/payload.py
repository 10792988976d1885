"""The content of a result's page: packed arrays, and the data that its scripts need beside them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from lingo_mi.common.notebook import grey_range
from lingo_mi.geometry.base import Geometry
from lingo_mi.metrics.quality import psnr_2d
from lingo_mi.report.data import REAL, ReportData
from lingo_mi.report.figures import DIFFERENCE, MOST_POINTS
from lingo_mi.report.packing import MOST_VOXELS, Arrays, bits_within, block_means, preview
from lingo_mi.report.planes import planes, richest

MOST_PIXELS = 60 * 256**2  # of all held-out views in a page, each of rendered and measured
VOLUME_BYTES, VIEW_BYTES = 19e6, 6e6  # as text; with libraries, cloud and surfaces a page stays below 30 MB
SURFACE_VOXELS, MOST_VERTICES = 112, 60_000
MAP_BITS = 8  # of a map of errors, which ranks voxels: no more than its colours


def payload(data: ReportData, surfaces: bool = True, earlier: Arrays | None = None) -> tuple[dict, Arrays]:
    """Return the data of a report for the scripts, besides colours and history, and its arrays by name.

    Parameters
    ----------
    surfaces : bool
        Whether surfaces of the volume are among them, which take a second.
    earlier : Arrays or None
        The arrays of an earlier state of the same page; those that are the same still are taken from there.
    """
    arrays = Arrays(earlier)
    content: dict[str, Any] = {}
    if data.volume is not None:
        volumes = {'Reconstruction': data.volume}
        if data.truth is not None:
            volumes['Truth'] = data.truth
        content['slices'] = slice_payload(
            volumes,
            data.spacing,
            data.centre,
            arrays,
            'Truth' if data.truth is not None else None,
            of=(data.shape, data.preview),
            quantity=data.quantity,
        )
        if data.error_map is not None:
            content['slices'] |= error_maps({'Error map': data.error_map}, content['slices'], arrays)
    if data.views is not None:
        images = {'Rendered': data.views}
        reference = None
        if data.views_truth is not None:
            reference = data.reference
            images[reference] = data.views_truth
        content['views'] = view_payload(images, data.views_angles, data.pixel, arrays, reference)
        if data.views_truth is not None and data.views_angles is not None:
            content['views']['psnr'] = _psnr_by_view(data.views, data.views_truth, data.views_angles)
        if (residuals := data.metrics.get('residual_by_view')) and data.views_angles is not None:
            order = np.argsort(data.views_angles, kind='stable')
            rms = [residuals[i] for i in order]
            content['views']['residual'] = dict(angles=data.views_angles[order].tolist(), rms=rms)
    content['space'] = _space(data, arrays, surfaces)
    return content, arrays


def _psnr_by_view(views: np.ndarray, truth: np.ndarray, angles: np.ndarray) -> list[float | None]:
    """PSNR of each view in the order of their angles, dB, None if it is infinite; full scale is the largest value of all."""
    peak, order = float(truth.max()), np.argsort(angles, kind='stable')
    values = [psnr_2d(views[i : i + 1], truth[i : i + 1], peak) if peak > 0 else np.inf for i in order]
    return [value if np.isfinite(value) else None for value in values]


def slice_payload(
    volumes: dict[str, np.ndarray],
    spacing: Any,
    centre: Any,
    arrays: Arrays,
    reference: str | None = None,
    budget: float = VOLUME_BYTES,
    of: tuple | None = None,
    quantity: str = REAL,
) -> dict:
    """Volumes [x, y, z] on one grid, with one scale, as previews if they would take more than `budget` bytes.

    Parameters
    ----------
    spacing
        Spacing of the grid's voxels; `centre` is the grid's, mm.
    reference : str or None
        The volume that the others are compared with.
    of : tuple or None
        The grid's shape, and n, if the volumes are means of n^3 of its voxels already.
    quantity : str
        Their quantity, with its unit.
    """

    def candidates():
        for most in (MOST_VOXELS // 8**k for k in range(4)):
            small = {name: preview(np.asarray(v, np.float32), most) for name, v in volumes.items()}
            yield next(iter(small.values()))[1], {name: v for name, (v, _) in small.items()}

    factor, small = _add('volume', candidates(), arrays, budget)
    shown = next(iter(small.values()))
    full_shape = next(iter(volumes.values())).shape
    old, already = of or (full_shape, 1)
    by = [min(already, n) * min(factor, m) for n, m in zip(old, full_shape)]
    step = [float(s * b) for s, b in zip(spacing, by)]
    # Blocks begin at the first voxel; voxels left over at the far end are not shown.
    middle = [float(c + (n * b - m) * s / 2) for c, n, b, m, s in zip(centre, shown.shape, by, old, spacing)]
    chosen = small[reference] if reference else shown
    axes, start = planes(shown.shape), [richest(chosen, axis) for axis in range(3)]
    window = grey_range(np.concatenate([np.take(chosen, start[axis], axis).ravel() for axis in axes]))
    return dict(
        shape=list(shown.shape),
        spacing=step,
        centre=middle,
        preview=factor * already,
        axes=axes,
        start=start,
        window=[float(x) for x in window],
        quantity=quantity,
        volumes=[dict(name=name, array=f'volume{i}') for i, name in enumerate(small)],
        reference=list(small).index(reference) if reference else None,
    )


def error_maps(maps: dict[str, np.ndarray], slices: dict, arrays: Arrays) -> dict:
    """Maps of errors [x, y, z], not negative, on the grid of the volumes, by name; each with its own scale.

    Parameters
    ----------
    slices : dict
        Slices of these volumes, as `slices` gives them.
    """
    for i, values in enumerate(maps.values()):
        small = block_means(np.asarray(values, np.float32), slices['preview'])
        arrays.add(f'map{i}', small, 0.0, float(small.max()), MAP_BITS)
    return dict(maps=[dict(name=name, array=f'map{i}') for i, name in enumerate(maps)])


def view_payload(
    images: dict[str, np.ndarray],
    angles: Any,
    pixel: Any,
    arrays: Arrays,
    reference: str | None = None,
    budget: float = VIEW_BYTES,
) -> dict:
    """Held-out views [n, v, u], in the order of their angles; fewer and smaller ones if they are many and large.

    Parameters
    ----------
    reference : str or None
        The images that the others are compared with.
    """
    first = next(iter(images.values()))
    least = 1
    while first.size // least**2 > MOST_PIXELS and min(first.shape[1:]) // least >= 256:
        least += 1

    def candidates():
        for n in (least, *range(least + 1, min(first.shape[1:]) // 16 + 1)):
            size = max(1, (first.shape[1] // n) * (first.shape[2] // n))
            count = min(len(first), max(1, MOST_PIXELS // size))
            order = np.argsort(np.asarray(angles), kind='stable')[np.arange(count) * len(first) // count]
            # Packed as [u, v, view]: neighbours in a row are most alike.
            turned = {k: np.ascontiguousarray(_binned(v[order], n).transpose(2, 1, 0)) for k, v in images.items()}
            yield (n, order), turned

    (by, order), turned = _add('views', candidates(), arrays, budget)
    last = next(reversed(turned.values()))
    return dict(
        shape=list(last.shape[::-1]),
        pixel=[float(p * by) for p in pixel],
        unit='mm',
        total=len(first),
        binning=by,
        angles=[float(np.asarray(angles)[i]) for i in order],
        window=[float(x) for x in grey_range(last)],
        images=[dict(name=name, array=f'views{i}') for i, name in enumerate(turned)],
        reference=list(turned).index(reference) if reference else None,
    )


def _add(name: str, candidates: Iterable[tuple[Any, dict[str, np.ndarray]]], arrays: Arrays, budget: float) -> tuple:
    """Pack arrays, with one scale, as `name0`, `name1`, ...: the first candidate that stays within `budget` bytes, or the last.

    Parameters
    ----------
    candidates : Iterable[tuple[Any, dict[str, ndarray]]]
        What says how they were made, and the arrays, the largest first.

    Returns
    -------
    tuple
        The candidate.
    """
    for candidate in candidates:
        packed = candidate[1]
        low = min(float(v.min()) for v in packed.values())
        low, high = arrays.scale(f'{name}0', low, max(float(v.max()) for v in packed.values()))
        bits = bits_within(list(packed.values()), low, high, budget)
        if bits is not None:
            break
    for i, array in enumerate(packed.values()):
        arrays.add(f'{name}{i}', array, low, high, bits or 8)
    return candidate


def history(entries: Iterable[dict]) -> list[dict]:
    """The numbers of a history that JSON has."""
    numbers = int, float, np.number
    return [{k: float(v) for k, v in e.items() if isinstance(v, numbers) and np.isfinite(v)} for e in entries]


def colour_maps() -> dict[str, str]:
    """The colour maps of the pictures, 256 colours each, as hexadecimal digits."""
    import matplotlib

    def digits(name):
        return (matplotlib.colormaps[name](np.arange(256), bytes=True)[:, :3]).tobytes().hex()

    return dict(difference=digits(DIFFERENCE), error=digits('magma'), cloud=digits('plasma'))


def scanner(geometry: Geometry, most: int = 400) -> dict:
    """Sources and panels of the views, mm: of a parallel beam, where its rays come from at the volume's distance."""
    index = np.unique(np.linspace(0, len(geometry) - 1, min(len(geometry), most)).astype(int))
    rays = geometry.rays(curved=True)[index]
    x, y = np.array([[0, 1, 1, 0], [0, 0, 1, 1]]) * np.array(geometry.nDetector)[::-1, None]
    panels = np.stack([rays.points(view, x, y) for view in range(len(rays))])
    sources = rays.source
    if rays.parallel:
        reach = max(geometry.grid.size)
        sources = np.asarray(geometry.grid.centre) - 1.5 * reach * sources
    return dict(sources=sources.round(3).tolist(), panels=panels.round(3).tolist(), parallel=bool(rays.parallel))


def _space(data: ReportData, arrays: Arrays, surfaces: bool) -> dict:
    half = np.asarray(data.shape) * np.asarray(data.spacing) / 2
    low, high = np.asarray(data.centre) - half, np.asarray(data.centre) + half
    out: dict[str, Any] = dict(low=low.tolist(), high=high.tolist())
    if data.scanner is not None:
        out['scanner'] = scanner(data.scanner)
    if data.cloud_centres is not None and len(data.cloud_centres):
        out['cloud'] = _cloud(data, arrays)
    if surfaces and data.volume is not None and min(data.volume.shape) > 3:
        out['surfaces'] = _surfaces(data, arrays)
    return out


def _cloud(data: ReportData, arrays: Arrays) -> dict:
    centres, density = np.asarray(data.cloud_centres), np.asarray(data.cloud_density)
    keep = np.arange(len(centres))
    if len(centres) > MOST_POINTS:
        keep = np.random.default_rng(0).choice(len(centres), MOST_POINTS, replace=False)

    def add(name, values):
        values = np.asarray(values)[keep]
        arrays.add(name, values, float(values.min()), float(values.max()))

    add('centres', centres)
    add('densities', density)
    if data.cloud_scales is not None and data.cloud_quaternions is not None:
        add('scales', np.log(np.maximum(data.cloud_scales, 1e-6)))
        add('quaternions', data.cloud_quaternions)
    top = float(np.percentile(density, 99)) or 1.0
    ellipsoids = data.cloud_scales is not None
    return dict(count=len(keep), total=len(centres), top=top, unit=data.cloud_unit, ellipsoids=ellipsoids)


def _surfaces(data: ReportData, arrays: Arrays) -> list[dict]:
    """Two surfaces of the reconstruction: around all that is not air, and around the denser part of that (Otsu's thresholds)."""
    from skimage.filters import threshold_otsu
    from skimage.measure import marching_cubes

    out, least, most = [], -np.inf, SURFACE_VOXELS**3
    volume = np.asarray(data.volume, np.float32)
    for name in ('Outer surface', 'Inner surface'):
        inside = volume[volume > least]
        if inside.size < 64 or inside.min() == inside.max():
            break
        least = float(threshold_otsu(inside.astype(float)))
        size = most
        while True:
            small, by = preview(volume, size)
            closed = np.pad(small, 1, constant_values=min(0.0, float(small.min())))
            if min(small.shape) < 3 or not closed.min() < least < closed.max():
                return out
            vertices, faces, *_ = marching_cubes(closed, least)
            if len(vertices) <= MOST_VERTICES:
                break
            size //= 2
        factors = np.minimum(by, volume.shape)
        first = np.asarray(data.centre) - np.asarray(data.shape) * np.asarray(data.spacing) / 2
        points = first + (vertices - 0.5) * factors * np.asarray(data.spacing)
        key = f'surface{len(out)}'
        arrays.add(key + 'points', points, float(points.min()), float(points.max()))
        arrays.add(key + 'faces', faces.astype(float), 0, 65535)
        out.append(dict(name=name, level=least, unit='/mm' if data.quantity == REAL else '', array=key))
    return out


def _binned(images: np.ndarray, by: int) -> np.ndarray:
    """Means of by x by pixels."""
    if by == 1:
        return images
    n, rows, columns = images.shape[0], images.shape[1] // by, images.shape[2] // by
    return images[:, : rows * by, : columns * by].reshape(n, rows, by, columns, by).mean((2, 4))
