"""Check the derivatives of a scene's image against differences: a table of AD, differences and their relative error.

    lingo-mi gradcheck gaussians
    lingo-mi gradcheck my_scene.xml -n 20 --variant llvm_ad_rgb

The exit code is 1 if an error is above 1e-4, and 2 for a scene that cannot be checked.
"""

from lingo_mi.cli.common import Parser
from lingo_mi.common.runtime import use_variant
from lingo_mi.scene.shipped import scene_path


def parser() -> Parser:
    p = Parser(description=__doc__)
    p.add_argument(
        'scene', metavar='SCENE', help='a Mitsuba scene with the integrator lingo_xray, or the name of a shipped one'
    )
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    p.add_argument(
        '--step',
        type=float,
        default=1e-4,
        metavar='H',
        help="step of the differences, in parts of a Gaussian's smallest standard deviation (default: 1e-4)",
    )
    p.add_argument(
        '-n',
        dest='count',
        type=int,
        default=4,
        metavar='COUNT',
        help='Gaussians of every cloud and voxels of every grid to check, drawn at random (default: 4)',
    )
    return p


def main() -> int:
    args = parser().parse_args()
    use_variant(args.variant)
    from lingo_mi.validation.gradient_check import TOLERANCE, check_gradients, gradient_table, load_scene_file

    rows = check_gradients(load_scene_file(scene_path(args.scene)), args.step, args.count)
    worst = max(row.error for row in rows)
    print(gradient_table(rows))
    print(f'largest error {worst:.1e}, tolerance {TOLERANCE:.0e}')
    return int(not worst <= TOLERANCE)
