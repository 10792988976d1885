r"""DICOM-CT-PD: projections of clinical CT scanners, as in Mayo's and the TCIA's low-dose data. One file a view.

A CT scanner's software has corrected the frames, so that pixels are line integrals after RescaleSlope and RescaleIntercept. The
geometry is in private attributes. In cylindrical coordinates (rho, phi, z), a point is

.. math::

    (-\rho \sin \phi, \; \rho \cos \phi, \; z)

The panel is built around its focal centre, at (rho, phi, z), and a flying focal spot is displaced by the source's shifts.
Elements are counted from 1. As seen from the focal centre, the elements of a row run to the left, towards growing phi, and rows
run down, towards -z. Stored images have the panel's columns as rows.

Chen et al., "Development and validation of an open data format for CT projection data", Medical Physics 42 (2015), 6964; Moen et
al., "Low-dose CT image and projection dataset", Medical Physics 48 (2021), 902, table IV.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import CurvedGeometry, Geometry, Grid
from lingo_mi.geometry.trajectories import scanner_rays
from lingo_mi.raw.dicom_header import floats, needed
from lingo_mi.raw.recording import Taken

# Type of the stored value, and tag. Files without types store bytes.
ATTRIBUTES = {
    'NumberofDetectorRows': ('H', 0x70291010),
    'NumberofDetectorColumns': ('H', 0x70291011),
    'DetectorElementTransverseSpacing': ('f', 0x70291002),
    'DetectorElementAxialSpacing': ('f', 0x70291006),
    'DetectorFocalCenterAngularPosition': ('f', 0x70311001),
    'DetectorFocalCenterAxialPosition': ('f', 0x70311002),
    'DetectorFocalCenterRadialDistance': ('f', 0x70311003),
    'ConstantRadialDistance': ('f', 0x70311031),
    'DetectorCentralElement': ('f', 0x70311033),  # (column, row)
    'SourceAngularPositionShift': ('f', 0x7033100B),
    'SourceAxialPositionShift': ('f', 0x7033100C),
    'SourceRadialDistanceShift': ('f', 0x7033100D),
}
_SHAPE = 0x7029100B  # of the detector
_PANEL = (
    *('NumberofDetectorRows', 'NumberofDetectorColumns', 'DetectorElementTransverseSpacing'),
    *('DetectorElementAxialSpacing', 'ConstantRadialDistance'),
)
_SHIFTS = tuple(name for name in ATTRIBUTES if name.startswith('Source'))


@dataclass(frozen=True)
class _View:
    file: Path
    values: dict[str, np.ndarray]
    shape: str
    slope: float
    intercept: float
    turned: bool


def is_projection(header: Any) -> bool:
    """Return whether such a file has this DICOM header."""
    return any(tag in header for _, tag in ATTRIBUTES.values())


def numbers(file: Path, header: Any) -> _View:
    """Return the numbers of a header that an import needs: see `lingo_mi.raw.dicom`.

    Raises
    ------
    InputError
        If the image is not as large as the panel, or several frames are in one file.
    """
    values = {name: _value(header, kind, tag) for name, (kind, tag) in ATTRIBUTES.items()}
    if int(header.get('NumberOfFrames') or 1) != 1:
        raise InputError(f'{file}: holds several projections; write one file a projection, as DICOM-CT-PD has it')
    stored = int(header.Rows), int(header.Columns)
    panel = tuple(int(needed(file, _named(name), values[name], 1)[0]) for name in _PANEL[:2])
    if panel not in (stored, stored[::-1]):
        raise InputError(
            f'{file}: the panel has {panel} elements (rows, columns), but the image {stored} pixels; export it again'
        )
    return _View(
        file,
        {name: value for name, value in values.items() if value is not None},
        _text(header, _SHAPE),
        float(header.get('RescaleSlope', 1)),
        float(header.get('RescaleIntercept', 0)),
        panel == stored[::-1],  # also where both are the same
    )


def transmission(view: _View, pixels: np.ndarray) -> np.ndarray:
    """Shares of the unattenuated beam [v, u] of stored pixels."""
    p = view.slope * pixels.astype(np.float64) + view.intercept
    return np.exp(-(p.T if view.turned else p))


def taken(path: Path, views: list[_View]) -> Taken:
    """The scanner of all views, columns reversed.

    Raises
    ------
    InputError
        If an attribute is missing or differs between views that have one panel, or the panel is of another shape.
    """
    n, first = len(views), views[0]

    def each(name, count=1):
        optional = np.zeros(count) if name in _SHIFTS else None  # if the focal spot does not fly
        out = [needed(view.file, _named(name), view.values.get(name, optional), count) for view in views]
        return np.stack(out) if count > 1 else np.concatenate(out)

    def once(name, count=1):
        values = each(name, count)
        if np.ptp(values, axis=0).any():
            other = int(np.argmax((values != values[0]).reshape(n, -1).any(1)))
            raise InputError(f'{views[other].file}: {_named(name)} differs from {first.file.name}; give one scan')
        return values[0]

    if first.shape not in ('CYLINDRICAL', 'FLAT'):
        raise InputError(
            f'{first.file}: DetectorShape (7029,100B) must be CYLINDRICAL or FLAT, not {shown(first.shape)}; give geometry=FILE'
        )
    rows, columns, across, along, distance = (float(once(name)) for name in _PANEL)
    column, row = once('DetectorCentralElement', 2)
    phi, z, rho, turn, lift, back = (each(name) for name in list(ATTRIBUTES)[4:7] + list(_SHIFTS))
    angles, nDetector = phi + np.pi / 2, (int(rows), int(columns))
    off = ((row - (rows + 1) / 2) * along, (column - (columns + 1) / 2) * across)
    grid = Grid((nDetector[1], nDetector[1], nDetector[0]), 1.0)
    rays = scanner_rays(angles, rho, distance, nDetector, (along, across), offDetector=off, height=z)
    geometry = Geometry.from_poses(rays, nDetector, grid=grid)
    if first.shape == 'CYLINDRICAL':
        geometry = geometry.curved(distance)
    if any(values.any() for values in (turn, lift, back)):
        where, far = angles + turn, rho + back
        source = np.stack([far * np.cos(where), far * np.sin(where), z + lift], 1)
        geometry = _seen_from(geometry, source)
    return Taken(geometry, columns=-1)


def _seen_from(geometry, source):
    """The same panels, seen from sources [n, 3]."""
    flat = geometry.flat if isinstance(geometry, CurvedGeometry) else geometry
    rays = flat.rays()
    rays = type(rays)(source, rays.corner, rays.u, rays.v, parallel=False)
    moved = Geometry.from_poses(rays, flat.nDetector, grid=flat.grid)
    return CurvedGeometry(flat=moved, radius=geometry.radius) if isinstance(geometry, CurvedGeometry) else moved


def _value(header, kind, tag):
    element = header.get(tag)
    value = None if element is None else element.value
    if isinstance(value, bytes):
        size = struct.calcsize(kind)
        value = struct.unpack(f'<{len(value) // size}{kind}', value[: len(value) // size * size])
    return floats(value)


def _text(header, tag):
    value = header[tag].value if tag in header else ''
    return (value.decode('ascii', 'replace') if isinstance(value, bytes) else str(value)).strip('\0 ').upper()


def _named(name):
    _, tag = ATTRIBUTES[name]
    return f'{name} ({tag >> 16:04X},{tag & 0xFFFF:04X})'
