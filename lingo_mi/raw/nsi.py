"""The .nsipro of North Star Imaging: where source, panel and axis are, as vectors from a point of the axis.

Its lines are `<name>value`, in sections `<Section>` to `</Section>`. The reference is the centre of the first pixel, the normal
points from the source to the panel, the horizontal along its rows, and columns run along normal x horizontal. These facts come
from MBIRJAX's reader (`mbirjax.preprocess.nsi`).
"""

from __future__ import annotations

import re
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.geometry.limits import MOST_VIEWS
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import rotation
from lingo_mi.raw.recording import Taken
from lingo_mi.storage.file_access import reading


def read_nsipro(path: PathLike | str) -> Taken:
    """The scan that a .nsipro describes: a circle, or poses if the panel is turned.

    Raises
    ------
    InputError
        If the file is missing or damaged, lacks a value, or its radiographs are turned by a quarter.
    """
    path = Path(path)
    with reading(path):
        text = path.read_text(encoding='utf-8', errors='replace')

    def value(section, name):
        inside = re.search(rf'<{section}>(.*?)</{section}>', text, re.DOTALL)
        match = re.search(rf'<{name}>([^<\r\n]*)', inside[1]) if inside else None
        if match is None or not match[1].strip():
            raise InputError(f'{path}: {name} of <{section}> is missing; give the .nsipro of the scan')
        return match[1].strip()

    def numbers(section, name, count):
        try:
            vector = np.array(value(section, name).split(), float)
        except ValueError:
            vector = np.full(1, np.nan)
        if vector.shape != (count,) or not np.isfinite(vector).all():
            raise InputError(
                f'{path}: {name} of <{section}> must be {count} number{"s" * (count > 1)}, not {shown(value(section, name))}'
            )
        return vector

    source, reference, axis, normal, along = (
        numbers('Result', name, 3) for name in ('source', 'reference', 'axis', 'normal', 'horizontal')
    )
    across, down = numbers('Object Radiograph', 'pitch', 2)
    n, step = (float(numbers('Object Radiograph', name, 1)[0]) for name in ('number', 'angleStep'))
    rows, columns = (int(numbers('Detector', f'{side} pixels', 1)[0]) for side in ('height', 'width'))
    turned = float(numbers('Correction', 'rotate', 1)[0]) % 360
    if turned not in (0, 180):
        raise InputError(f'{path}: its radiographs are turned by {turned:g} degrees: turn them back, and give a .yml')
    flips = [value('Correction', name) == 'True' for name in ('flipV', 'flipH')]
    lengths = [np.linalg.norm(vector) for vector in (axis, normal, along, np.cross(source, axis))]
    if not 1 <= n <= MOST_VIEWS or not min(lengths) > 0:
        raise InputError(f'{path}: needs 1 to {MOST_VIEWS} radiographs, and vectors that are not zero')
    axis, normal, along = (vector / length for vector, length in zip((axis, normal, along), lengths))
    # Our z is up the axis, against the panel's columns; x points to the source.
    up = -axis * np.sign(axis @ np.cross(normal, along))
    x = source - (source @ up) * up
    x /= np.linalg.norm(x)
    frame = np.stack([x, np.cross(up, x), up])
    u, v = frame @ along * across, frame @ np.cross(normal, along) * down
    corner = frame @ reference - (u + v) / 2
    first = Rays(*(np.tile(vector, (int(n), 1)) for vector in (frame @ source, corner, u, v)), parallel=False)
    sense = 1 if value('Processed', 'clockwise') == 'True' else -1
    rays = first.moved(rotation('z', np.radians(sense * step * np.arange(int(n)))))
    geometry = Geometry.from_poses(rays, (rows, columns), grid=Grid((columns, columns, rows), 1.0))
    flip_v, flip_h = (-1 if flip != (turned == 180) else 1 for flip in flips)
    return Taken(geometry, columns=flip_h, rows=flip_v)
