"""A scene's scan with voxels that are (nearly) boxes of constant density, as a file of X3D's kind.

    python -m studies.box_voxels x3d_aneurism aneurism_boxes.pickle
    lingo-mi fit x3d_aneurism --projections aneurism_boxes.pickle --method r2

X3D's views are made by TIGRE's default projector, Siddon's, which takes a voxel for a box. This package's views are exact for
the trilinear interpolant of voxels. Here every voxel is cut into --cut pieces a side of its own density, whose interpolant is
constant but within half a piece of its faces. The scanned object is the scene's true volume on the scanner's voxels.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lingo_mi.api.data import simulate
from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.common.progress import Progress
from lingo_mi.common.runtime import use_variant
from lingo_mi.files.scans import write_scan
from lingo_mi.projectors import grid
from lingo_mi.scan import Dataset, Scan
from studies.command import run_study


def with_boxes(dataset: Dataset, cut: int = 2) -> Dataset:
    """The same views of the true volume, with each voxel cut into `cut` pieces a side of its own density.

    Raises
    ------
    InputError
        For a data set without a true volume.
    """
    if dataset.volume is None:
        raise InputError('the true volume of this scan is not known: take a scene whose object is a volume')
    fine = dataset.volume
    for axis in range(3):
        fine = np.repeat(fine, cut, axis)

    def scanned(scan: Scan) -> Scan:
        pieces = scan.geometry.on(scan.geometry.grid.finer(cut))
        with Progress('Scan of boxes', len(scan)) as bar:
            return replace(scan, projections=grid.project_volume(fine, pieces, lambda done, _: bar.update(done)))

    return Dataset(scanned(dataset.train), dataset.test and scanned(dataset.test), dataset.volume)


def main() -> None:
    p = Parser(description=__doc__)
    p.add_argument('scene', help='a scene file, or the name of a shipped one')
    p.add_argument('out', type=Path, metavar='F.pickle', help='the scan, for --projections')
    p.add_argument('--cut', type=int, default=2, metavar='N', help='pieces of a voxel along each side (default 2)')
    args = p.parse_args()
    if args.cut < 1:
        raise InputError(f'--cut must be at least 1, not {args.cut}')
    if args.out.exists():
        raise InputError(f'{args.out}: exists already; choose another name')
    use_variant(None)
    write_scan(args.out, with_boxes(simulate(args.scene), args.cut), 'naf')


if __name__ == '__main__':
    run_study('box_voxels', main)
