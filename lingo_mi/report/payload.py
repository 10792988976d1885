"""What a page holds of a result: arrays, packed, and what its scripts need to know beside them."""

from __future__ import annotations

from typing import Any

import numpy as np

from lingo_mi.geometry.base import Geometry
from lingo_mi.report.data import ReportData
from lingo_mi.report.figures import DIFFERENCE, MOST_POINTS
from lingo_mi.report.packing import MOST_VOXELS, Packed, bits_within, pack, preview
from lingo_mi.report.planes import grey_range, planes, richest

MOST_PIXELS = 60 * 256**2  # of all held-out views in a page, each of rendered and measured
VOLUME_BYTES, VIEW_BYTES = 19e6, 6e6  # as text; with libraries, cloud and surfaces a page stays below 30 MB
SURFACE_VOXELS, MOST_VERTICES = 112, 60_000
MAP_BITS = 8  # of a map of errors, which ranks voxels: no more than its colours

Arrays = dict[str, Packed]


def payload(data: ReportData, surfaces: bool = True) -> tuple[dict, Arrays]:
    """What the scripts know of a report, and its arrays by name.

    surfaces   whether surfaces of the volume are among them, which take a second
    """
    arrays: Arrays = {}
    known: dict[str, Any] = dict(colours=colour_maps(), history=[_finite(entry) for entry in data.history])
    if data.volume is not None:
        volumes = {'Reconstruction': data.volume}
        if data.truth is not None:
            volumes['Truth'] = data.truth
        known['slices'] = slices(
            volumes, data.spacing, data.centre, arrays, 'Truth' if data.truth is not None else None
        )
        if data.error_map is not None:
            known['slices'] |= error_maps({'Error map': data.error_map}, known['slices'], arrays)
    if data.views is not None:
        images = {'Rendered': data.views}
        if data.views_truth is not None:
            images['Measured'] = data.views_truth
        reference = 'Measured' if len(images) == 2 else None
        known['views'] = views(images, data.views_angles, data.pixel, arrays, reference)
    known['space'] = _space(data, arrays, surfaces)
    return known, arrays


def slices(
    volumes: dict[str, np.ndarray],
    spacing: Any,
    centre: Any,
    arrays: Arrays,
    reference: str | None = None,
    budget: float = VOLUME_BYTES,
) -> dict:
    """Volumes [x, y, z] on one grid, with one scale, as previews where they would take more than `budget` bytes.

    reference   the volume that the others are compared with
    """
    most = MOST_VOXELS
    low = min(float(v.min()) for v in volumes.values())
    high = max(float(v.max()) for v in volumes.values())
    while True:
        small = {name: preview(np.asarray(v, np.float32), most) for name, v in volumes.items()}
        bits = bits_within([v for v, _ in small.values()], low, high, budget)
        if bits is not None or most < 64**3:
            break
        most //= 8
    shown, factor = next(iter(small.values()))
    old = next(iter(volumes.values())).shape
    by = [min(factor, n) for n in old]
    step = [float(s * b) for s, b in zip(spacing, by)]
    # Blocks begin at the first voxel; voxels left over at the far end are not shown.
    middle = [float(c + (n * b - m) * s / 2) for c, n, b, m, s in zip(centre, shown.shape, by, old, spacing)]
    for i, (volume, _) in enumerate(small.values()):
        arrays[f'volume{i}'] = pack(volume, low, high, bits or 8)
    chosen = small[reference][0] if reference else shown
    axes = planes(shown.shape)
    window = grey_range(np.concatenate([np.take(chosen, richest(chosen, a), a).ravel() for a in axes]))
    return dict(
        shape=list(shown.shape),
        spacing=step,
        centre=middle,
        preview=factor,
        axes=axes,
        start=[richest(chosen, axis) for axis in range(3)],
        window=[float(x) for x in window],
        unit='1/mm',
        volumes=[dict(name=name, array=f'volume{i}') for i, name in enumerate(small)],
        reference=list(small).index(reference) if reference else None,
    )


def error_maps(maps: dict[str, np.ndarray], known: dict, arrays: Arrays) -> dict:
    """Maps of errors [x, y, z], not negative, on the grid of the volumes, by name; each with its own scale.

    known   of these volumes, as `slices` gives it
    """
    for i, values in enumerate(maps.values()):
        small = preview(np.asarray(values, np.float32), MOST_VOXELS)[0]
        while small.size > np.prod(known['shape']):  # previews have been made smaller
            small = preview(values, small.size // 8)[0]
        arrays[f'map{i}'] = pack(small, 0.0, float(small.max()), MAP_BITS)
    return dict(maps=[dict(name=name, array=f'map{i}') for i, name in enumerate(maps)])


def views(
    images: dict[str, np.ndarray],
    angles: Any,
    pixel: Any,
    arrays: Arrays,
    reference: str | None = None,
    budget: float = VIEW_BYTES,
) -> dict:
    """Held-out views [n, v, u], in the order of their angles; fewer and smaller ones where they are many and large.

    reference   the images that the others are compared with
    """
    first = next(iter(images.values()))
    count, by = len(first), 1
    while count * (first.shape[1] // by) * (first.shape[2] // by) > MOST_PIXELS and min(first.shape[1:]) // by >= 256:
        by += 1
    while True:
        size = max(1, (first.shape[1] // by) * (first.shape[2] // by))
        count = min(len(first), max(1, MOST_PIXELS // size))
        order = np.argsort(np.asarray(angles), kind='stable')[np.arange(count) * len(first) // count]
        small = {name: _binned(v[order], by) for name, v in images.items()}
        low = min(float(v.min()) for v in small.values())
        high = max(float(v.max()) for v in small.values())
        # Packed as [u, v, view]: neighbours in a row are most alike.
        turned = {name: np.ascontiguousarray(v.transpose(2, 1, 0)) for name, v in small.items()}
        bits = bits_within(list(turned.values()), low, high, budget)
        if bits is not None or min(first.shape[1:]) // (by + 1) < 16:
            break
        by += 1
    for i, image in enumerate(turned.values()):
        arrays[f'views{i}'] = pack(image, low, high, bits or 8)
    shown = next(iter(small.values()))
    return dict(
        shape=list(shown.shape),
        pixel=[float(p * by) for p in pixel],
        total=len(first),
        binning=by,
        angles=[float(np.asarray(angles)[i]) for i in order],
        window=[float(x) for x in grey_range(next(reversed(small.values())))],
        images=[dict(name=name, array=f'views{i}') for i, name in enumerate(small)],
        reference=list(small).index(reference) if reference else None,
    )


def colour_maps() -> dict[str, str]:
    """The colour maps of the pictures, 256 colours each, as hexadecimal digits."""
    import matplotlib

    def digits(name):
        return (matplotlib.colormaps[name](np.arange(256), bytes=True)[:, :3]).tobytes().hex()

    return dict(difference=digits(DIFFERENCE), error=digits('magma'), cloud=digits('plasma'))


def scanner(geometry: Geometry, most: int = 400) -> dict:
    """Sources and panels of the views, mm: of a parallel beam, where its rays come from at the volume's distance."""
    index = np.unique(np.linspace(0, len(geometry) - 1, min(len(geometry), most)).astype(int))
    rays = geometry.rays()[index]
    (nv, nu), corner = geometry.nDetector, rays.corner
    panels = np.stack([corner, corner + nu * rays.u, corner + nu * rays.u + nv * rays.v, corner + nv * rays.v], 1)
    sources = rays.source
    if rays.parallel:
        reach = float(np.max(geometry.nVoxel * np.asarray(geometry.dVoxel)))
        sources = np.asarray(geometry.offOrigin) - 1.5 * reach * sources
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
        arrays[name] = pack(values, float(values.min()), float(values.max()))

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
        least = float(threshold_otsu(inside))
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
        arrays[key + 'points'] = pack(points, float(points.min()), float(points.max()))
        arrays[key + 'faces'] = pack(faces.astype(float), 0, 65535)
        out.append(dict(name=name, level=least, array=key))
    return out


def _binned(images: np.ndarray, by: int) -> np.ndarray:
    """Means of by x by pixels."""
    if by == 1:
        return images
    n, rows, columns = images.shape[0], images.shape[1] // by, images.shape[2] // by
    return images[:, : rows * by, : columns * by].reshape(n, rows, by, columns, by).mean((2, 4))


def _finite(entry: dict) -> dict:
    """The numbers of an entry that JSON has."""
    return {k: float(v) for k, v in entry.items() if isinstance(v, (int, float, np.number)) and np.isfinite(v)}
