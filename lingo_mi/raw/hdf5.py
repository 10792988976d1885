"""Raw frames in HDF5: NXtomo (image_key) and DXchange (/exchange/data)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.raw.recording import Frames, Recording
from lingo_mi.storage.file_access import optional

LINKED = 4  # groups below the root in which frames are looked for: entry, subentry, instrument, detector


def open_hdf5(path: Path) -> Recording:
    """The frames of an NXtomo or DXchange file, with its flats, darks and angles.

    Raises
    ------
    InputError
        If it is neither, links to a file that is not there, or its parts do not agree.
    """
    h5py = optional('h5py')
    file = h5py.File(path, 'r')

    def stack(data):
        if data.ndim == 2:
            return Frames(str(path), 1, data.shape, data.dtype, lambda i: data[()])
        if data.ndim != 3:
            raise InputError(f'{path}: {data.name} has the shape {data.shape}; frames are [n, v, u]')
        return Frames(str(path), len(data), data.shape[1:], data.dtype, lambda i: data[i])

    _require_links(path, file)
    if 'exchange/data' in file:  # DXchange
        group = file['exchange']
        flats, darks = (
            stack(group[name]) if name in group and len(group[name]) else None for name in ('data_white', 'data_dark')
        )
        angles = np.asarray(group['theta'], float).ravel() if 'theta' in group else None
        if angles is not None and _unit(group['theta']).startswith('rad'):
            angles = np.degrees(angles)
        return Recording(stack(group['data']), flats, darks, angles)
    entry = _nxtomo(file)
    if entry is None:
        raise InputError(f'{path}: is neither DXchange (/exchange/data) nor NXtomo (instrument/detector/data)')
    detector = entry['instrument/detector']
    every = stack(detector['data'])
    # ESRF's image_key_control also tells alignment frames (-1), which image_key takes for views.
    name = 'image_key_control' if 'image_key_control' in detector else 'image_key'
    key = np.asarray(detector[name], int) if name in detector else np.zeros(len(every), int)
    if key.shape != (len(every),):
        raise InputError(f'{path}: {name} has {key.size} entries for {len(every)} frames; these must agree')

    def of(kind):
        return every.subset(np.flatnonzero(key == kind)) if (key == kind).any() else None

    views = of(0)
    if views is None:
        raise InputError(f'{path}: {name} marks no projection (0); nothing can be imported')
    angles = None
    if 'sample/rotation_angle' in entry:
        data = entry['sample/rotation_angle']
        angles = np.asarray(data, float).ravel()
        angles = np.degrees(angles) if _unit(data).startswith('rad') else angles
        angles = angles[key == 0] if len(angles) == len(key) else angles
    return Recording(views, of(1), of(2), angles)


def _require_links(path, file):
    """Raises InputError if data are in another file that is not there: HDF5 says no more than that it cannot open it."""
    h5py = optional('h5py')

    def follow(group, depth):
        for name in group:
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                target = Path(path).parent / link.filename  # an absolute name stays
                if not target.exists():
                    raise InputError(
                        f'{path}: {group.name.rstrip("/")}/{name} is a link to {link.filename}, which is not there; put that '
                        f'file beside {Path(path).name}'
                    )
            elif depth and isinstance(link, h5py.HardLink) and group.get(name, getclass=True) is h5py.Group:
                follow(group[name], depth - 1)

    follow(file, LINKED)


def _nxtomo(file):
    """The first group with instrument/detector/data, among the root, its entries and their subentries."""
    groups = [file, *file.values()]
    for group in list(groups):
        if hasattr(group, 'values') and group is not file:
            groups += list(group.values())
    return next((g for g in groups if hasattr(g, 'values') and 'instrument/detector/data' in g), None)


def _unit(data):
    unit = np.ravel(data.attrs.get('units', 'degree'))[0]  # also of an array of one
    return (unit.decode() if isinstance(unit, bytes) else str(unit)).lower()
