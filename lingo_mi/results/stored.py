"""What a folder of a result holds, read for a comparison: numbers, volume and held-out views. Needs no Mitsuba variant."""

from __future__ import annotations

from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.images import read_exr
from lingo_mi.files.slabs import plan_and_error_map
from lingo_mi.files.volumes import Volume, read_volume
from lingo_mi.metrics.quality import current_names
from lingo_mi.scan import values_digest
from lingo_mi.storage.file_access import as_path, parsed_json, reading
from lingo_mi.storage.output_folder import METRICS, VIEWS, VOLUME, require_together


@dataclass(frozen=True, eq=False)
class Stored:
    """A result on disk.

    name      of its folder or file
    metrics   as metrics.json has them; {} of a volume alone
    volume    its density; None for a recipe without
    views     float32 [view, v, u], rendered held-out views; None if there are none
    angles    [view] degrees
    error_map  the file V-error.nii.gz beside a volume V.nii.gz, as `reconstruct --algorithm best` writes it; None: there is none
    """

    name: str
    metrics: dict = field(default_factory=dict)
    volume: Volume | None = None
    views: np.ndarray | None = None
    angles: list[float] = field(default_factory=list)
    error_map: Volume | None = None


def _planned(plan: Path) -> str | None:
    """The check sum of the volume that a plan of `best` has made, where there is one that says."""
    try:
        found = parsed_json(plan.read_text(encoding='utf-8'))
        return found.get('volume')
    except (OSError, ValueError, AttributeError):
        return None


def read_stored(path: PathLike | str) -> Stored:
    """A result from the folder that `lingo-mi fit` or `Result.save` wrote, or a volume from a file, such as `reconstruct` writes.

    Raises InputError where there is none, a file is damaged, or files do not belong together.

        read_stored('out/foot').metrics['psnr_3d']
    """
    path = as_path('path', path)
    if path.is_file() or path.name.lower().endswith('.zarr'):
        name = path.name.removesuffix('.gz').removesuffix('.zarr').rsplit('.', 1)[0]
        plan, errors = plan_and_error_map(path)
        volume = read_volume(path)
        of_it = errors.exists() and _planned(plan) in (None, values_digest(volume.data))
        return Stored(name, volume=volume, error_map=read_volume(errors) if of_it else None)
    numbers = path / METRICS
    with reading(path, folder=True):
        if not numbers.exists():
            raise InputError(f'{path}: there is no result here; give a folder that lingo-mi fit wrote, or a volume')
    try:
        with reading(numbers):
            metrics = current_names(parsed_json(numbers.read_text(encoding='utf-8')))
        angles = [float(angle) for angle in metrics.get('test_angles') or []]
    except (TypeError, ValueError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f'{numbers}: is damaged; fit again') from None
    images = sorted((path / VIEWS).glob('*.exr')) if (path / VIEWS).is_dir() else []
    require_together(path, [VOLUME, *(f'{VIEWS}/{image.name}' for image in images)])
    volume = read_volume(path / VOLUME) if (path / VOLUME).exists() else None
    views = None
    if images and len(images) == len(angles):
        found = [read_exr(image) for image in images]
        if len({image.shape for image in found}) > 1:
            raise InputError(f'{path / VIEWS}: the views are of several sizes; fit again')
        views = np.stack(found)
    return Stored(Path(path.resolve()).name, metrics, volume, views, angles)
