"""The folder of R2-Gaussian: `meta_data.json`, the true volume and one .npy file per projection.

- `meta_data.json`: {"scanner": {...}, "vol" (or "ct"): file, "bbox", "proj_train", "proj_test": [{"file_path", "angle"}]}

Lengths have any one unit (its synthetic scans have DSD 7, DSO 5, sVoxel 2), and so have the projections' line
integrals; here the numbers are taken as mm. nDetector and sDetector are (v, u), rows along -z; nVoxel, sVoxel
and offOrigin (x, y, z); angles are radians. offDetector is (u, v) and reaches TIGRE as (v, u).
"""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import require_room
from lingo_mi.files import arrays
from lingo_mi.files.scanner_dict import (
    angle_range,
    circular_geometry,
    from_geometry,
    make_dataset,
    make_scan,
    to_geometry,
)
from lingo_mi.geometry.limits import MOST_VIEWS
from lingo_mi.scan import Dataset
from lingo_mi.storage.file_access import beside, new_folder, one_line, reading

META = 'meta_data.json'


def _views(meta, split, where):
    listed = meta.get(f'proj_{split}')
    if not listed:
        return None
    if not isinstance(listed, list):
        raise InputError(f'{where}: proj_{split} must be a list of views')
    if len(listed) > MOST_VIEWS:
        raise InputError(f'{where}: proj_{split} lists {len(listed)} views, but a scan has at most {MOST_VIEWS}')
    projections, angles = [], []
    for i, view in enumerate(listed):
        try:
            name, angle = view['file_path'], float(view['angle'])
        except (TypeError, KeyError, ValueError, OverflowError):
            raise InputError(
                f"{where}: entry {i} of proj_{split} must have a 'file_path' and an 'angle' in radians"
            ) from None
        file = beside(where, name)
        image = arrays.read_npy(file, 2)
        if projections and image.shape != projections[0].shape:
            raise InputError(
                f'{file}: has the shape {image.shape}, but the first view has '
                f'{projections[0].shape}; all views need one panel'
            )
        if not projections:
            require_room(8 * len(listed) * image.size, where)
        projections.append(image)
        angles.append(angle)
    geometry = to_geometry(meta['scanner'], angles, where, offset_order='uv')
    return make_scan(geometry, np.stack(projections), where)


def read_r2(path: PathLike | str) -> Dataset:
    """Reads an R2-Gaussian folder.

    Returns
    -------
    Dataset
        A Dataset; the test views and the volume are None if the folder has none.

    Raises
    ------
    InputError
        If a file is missing or damaged, or shapes and geometry disagree.
    """
    folder = Path(path)
    where = folder / META
    try:
        with reading(where):
            meta = json.loads(where.read_text(encoding='utf-8'))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f'{where}: is not valid JSON ({one_line(error)}); correct or regenerate it') from None
    if not isinstance(meta, dict) or not isinstance(meta.get('scanner'), dict):
        raise InputError(f"{where}: has no 'scanner'; add the dictionary of the scan geometry")
    train = _views(meta, 'train', where)
    if train is None:
        raise InputError(f"{where}: 'proj_train' lists no views; give at least one")
    volume = meta.get('vol', meta.get('ct'))
    if volume is not None:
        volume = arrays.read_npy(beside(where, volume), 3)
    return make_dataset(train, _views(meta, 'test', where), volume, where)


def write_r2(path: PathLike | str, dataset: Dataset) -> None:
    """Writes a new R2-Gaussian folder, whole or not at all; lengths and projections stay in mm.

    R2-Gaussian itself cannot read a folder without a volume.

    Raises
    ------
    InputError
        If the folder exists and is not empty, cannot be written, or the test views have another scanner.
    """
    geometry = circular_geometry(dataset, path)
    start, total = angle_range(geometry.angles)
    scanner = {
        **from_geometry(geometry, offset_order='uv'),
        'sDetector': list(geometry.sDetector),
        'sVoxel': list(geometry.grid.size),
        'filter': None,
        'accuracy': 0.5,
        'totalAngle': total,
        'startAngle': start,
        'noise': False,
    }
    grid = geometry.grid
    meta = {'scanner': scanner, 'bbox': [grid.low.tolist(), grid.high.tolist()]}
    with new_folder(path) as folder:
        if dataset.volume is not None:
            meta['vol'] = 'vol_gt.npy'
            arrays.write_npy(folder / meta['vol'], np.asarray(dataset.volume, np.float32))
        for split, scan in (('proj_train', dataset.train), ('proj_test', dataset.test)):
            meta[split] = []
            if scan is None:
                continue
            (folder / split).mkdir()
            for i, (image, angle) in enumerate(zip(scan.projections, scan.geometry.angles)):
                name = f'{split}/{split}_{i:04d}.npy'
                arrays.write_npy(folder / name, image)
                meta[split].append({'file_path': name, 'angle': float(angle)})
        (folder / META).write_text(json.dumps(meta, indent=4), encoding='utf-8')
