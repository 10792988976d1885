"""Reconstruct one scan by this package's methods and by RTK and MBIRJAX, and compare the volumes without a known truth.

    python -m studies.peers walnut --views 15 30 60
    python -m studies.peers walnut --views 30 -D voxels=256 -D voxel_size=0.1525 --methods asd-pocs mbirjax best
    python -m studies.peers scenes/mine.xml --projections scan.npy --views 40

Every method gets the same few, evenly spaced views. The table says how well its volume predicts the views that are left, or those
that the scan holds out itself, as root mean square of line integrals in valid pixels; how near it is to the FDK of all views, or
to the true volume if it is known; and how long it took.
Each volume is stored as NIfTI when it is done, and the same command goes on after an interruption. The table, as Markdown, is
updated after each, with its provenance; slices.png shows the middle slice of all. Settings are defaults, but MBIRJAX's densities
are kept from being negative, and refined has what is advised for measured objects: finer=2, niter=4 and no completed views.
MBIRJAX's sharpness and the beta of RTK's total variation are each chosen among four values by views that are held out, which
their times include; mbirjax:1 and rtk-tv:10 have the value that they name.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from lingo_mi.cli.common import Parser, check_input, definitions, input_arguments, read_input
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.shipped import scene_path
from lingo_mi.storage.file_access import require_writable
from studies.command import run_study, updated_table


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    input_arguments(p)
    p.add_argument('--views', dest='counts', nargs='+', type=int, default=[30], metavar='N', help='(default: 30)')
    p.add_argument('--methods', nargs='+', metavar='NAME', help='such as fdk best (default: all that are installed)')
    p.add_argument('--out', type=Path, default=Path('out/peers'), help='folder of the results')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    p.add_argument(
        '-D', dest='define', action='append', default=[], metavar='NAME=VALUE', help='a parameter of the scene file'
    )
    p.set_defaults(views=None)  # all of them are read
    return p.parse_args()


def main() -> None:
    args = arguments()
    check_input(args)
    use_variant(args.variant)
    from studies.peers.study import METHODS, Study, installed, method_of

    for name in args.methods or ():
        method_of(name)  # raises for an unknown one
    methods = installed(args.methods or METHODS, print)
    scene = scene_path(args.scene)
    dataset = read_input(args, load_scene(scene, definitions(args.define)), None)
    dataset = replace(dataset, train=line_integrals(dataset.train), test=dataset.test and line_integrals(dataset.test))
    for count in args.counts:
        if not 4 <= count < len(dataset.train):
            raise InputError(f'--views must be from 4 to {len(dataset.train) - 1}, so that some are left, not {count}')
    geometry = dataset.train.geometry
    folder = args.out / '_'.join([Path(args.projections or scene).stem, *map(str, geometry.grid.shape)])
    require_writable(folder, folder, 'choose another --out')
    study = Study(dataset, folder)
    with updated_table(folder / 'peers.md', lambda: study.table(methods, args.counts)) as update:
        study.compute_missing(methods, args.counts, update)
    study.draw(methods, args.counts, folder / 'slices.png')
    print(folder / 'slices.png')


if __name__ == '__main__':
    run_study('peers', main)
