"""Helpers of all commands: clear failures, Ctrl-C, and the arguments of a scene and of the documentation."""

from __future__ import annotations

import argparse
import difflib
import io
import os
import re
import shlex
import sys
import textwrap
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np

from lingo_mi.common import parsing
from lingo_mi.common.errors import InputError, brief, shown
from lingo_mi.common.interrupts import noticed
from lingo_mi.files.units import unit_of
from lingo_mi.scene.shipped import scene_path, scenes
from lingo_mi.storage.file_access import require_new_folder, require_writable


class Help(argparse.HelpFormatter):
    """Help whose text fills the terminal.

    Paragraphs are filled, and so is the second column of a list, which two spaces begin. Commands are not broken, so that they
    can be copied.
    """

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        blocks: list[tuple[str, int]] = [('', -1)]  # text, and how far lines that continue it are indented
        for line in text.strip().split('\n'):
            margin = len(line) - len(line.lstrip())
            command = line.lstrip().startswith(('lingo-mi ', 'python '))
            if line and not command and margin == blocks[-1][1]:
                blocks[-1] = f'{blocks[-1][0]} {line.lstrip()}', margin
            else:
                column = re.match(r' +\S.*?  +(?=\S)', line)
                blocks.append((line, -1 if command or not line else column.end() if column else margin))
        return '\n'.join(
            block if margin < 0 else textwrap.fill(block, width, subsequent_indent=' ' * margin)
            for block, margin in blocks[1:]
        )


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, like any other bad input. `running` is the last one that has parsed, with
    what it has read."""

    running: ClassVar[tuple[Parser, argparse.Namespace] | None] = None

    def __init__(self, **settings: Any) -> None:
        super().__init__(formatter_class=Help, **settings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        parsed = super().parse_known_args(args, namespace)
        Parser.running = self, parsed[0]
        return parsed

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            error.message += parsing.nearest(str(value), map(str, action.choices or ()))
            raise

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:  # type: ignore[override]
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            name = unknown[0].partition('=')[0]
            # Compared without the dashes, which all options share.
            options = {option.lstrip('-'): option for option in self._option_string_actions}
            near = difflib.get_close_matches(name.lstrip('-'), options, 1)
            hint = f', did you mean {options[near[0]]}?' if near else ''
            self.error(f'unrecognized arguments: {" ".join(unknown)}{hint}')
        return parsed

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'error: {brief(message, 250)} (see --help)\n')


def guard(main: Callable[[], int | None]) -> None:
    """Run a command's main function and exit: 2 with one line for bad input, 130 after Ctrl-C.

    Each warning becomes one line. Warnings of arithmetic are left out, because the results are checked.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files need not be text
        sys.stdout.reconfigure(errors='backslashreplace')
    try:
        with noticed(), warnings.catch_warnings():
            warnings.simplefilter('ignore', RuntimeWarning)
            warnings.showwarning = lambda message, *_: print(
                f'warning: {brief(with_options(str(message)), 1000)}', file=sys.stderr
            )
            sys.exit(main() or 0)
    except InputError as error:
        print(f'error: {brief(with_options(str(error)))}', file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        text = f'{f"{error.filename}: " if error.filename else ""}{error.strerror or error}'
        print(f'error: {brief(text)}', file=sys.stderr)
        sys.exit(2)
    except MemoryError as error:
        print(f'error: not enough memory ({brief(error, 250)})', file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        print(f'interrupted{": " + str(stop) if str(stop) else ""}', file=sys.stderr)
        sys.exit(130)


# An argument of Python, name=value, that is not in a call or a path and not an option already.
ARGUMENT = re.compile(r"""(?<!-D )(?<!\w\()(?<![\w"'/.=-])([A-Za-z]\w*)=(\([^()]*\)|'[^']*'|[^\s'",;:()]+)""")


def with_options(message: str) -> str:
    """A library's message with the running command's options for Python's arguments: `slab=64` becomes `--slab 64`, `resume=True`
    `--resume`, and `lambda_tv=0.1` `-D lambda_tv=0.1`."""
    if Parser.running is None:
        return message
    parser, args = Parser.running
    options = {action.dest: action for action in parser._actions if action.option_strings}

    def written(match: re.Match) -> str:
        name, value = match[1], match[2].strip("'")
        parts = [part.strip() for part in value.strip('()').split(',')] if value.startswith('(') else [value]
        if (option := options.get(name)) is None:
            is_setting = 'define' in options and name in _settings(args)
            return f'-D {name}={",".join(parts)}' if is_setting else match[0]
        if option.nargs == 0:
            return option.option_strings[-1] if value == 'True' else match[0]
        several = len(parts) > 1 and option.nargs is None  # in one word, whose form the metavar shows
        return ' '.join([option.option_strings[-1], *([str(option.metavar)] if several else parts)])

    return ARGUMENT.sub(written, message)


def _settings(args: argparse.Namespace) -> set[str]:
    """The names that -D takes: options of methods and algorithms, and parameters of the scenes that are named."""
    from lingo_mi.fitting.methods.by_name import METHODS
    from lingo_mi.reconstruction import ALGORITHMS
    from lingo_mi.scene.load import defaults

    options = [method.flat() for method in METHODS.values()] + [
        algorithm().options for algorithm in ALGORITHMS.values()
    ]
    names = {name for part in options for name in part}
    for scene in [getattr(args, 'scene', None), *getattr(args, 'scenes', [])]:
        with suppress(InputError):
            names |= defaults(scene_path(scene)) if scene else set()
    return names


def command_line(*options: str, without: Collection[str] = ()) -> str:
    """The command that runs now, to be typed again: with further options, and without some."""
    program = f'python {sys.argv[0]}' if sys.argv[0].endswith('.py') else sys.argv[0]
    return ' '.join([program, shlex.join([*(a for a in sys.argv[1:] if a not in without), *options])])


SCANNER = 'scanner'  # the shipped scene for projections that come without a scene


def input_name(args: argparse.Namespace) -> str:
    """Return the name that results get: the name of the scene, or of the scan that replaces it."""
    scene = Path(args.scene).stem
    return Path(args.projections).stem if scene == SCANNER and args.projections else scene


def input_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say what is scanned: scene, --projections, --volume and what goes with them."""
    parser.add_argument(
        'scene',
        metavar='SCENE|SCAN',
        help='a Mitsuba scene with a ct_scanner, such as scenes/x3d_foot.xml; the name of a shipped one, x3d_foot; or measured '
        'projections, as --projections takes them',
    )
    parser.add_argument(
        '--projections',
        metavar='F',
        help='measured projections: X3D/NAF pickle, R2 folder, HTC or walnut .npz, '
        '.npy, .zarr or .h5 with a geometry .yml beside it, or a folder of EXR images',
    )
    parser.add_argument(
        '--volume',
        metavar='F',
        help="a CT volume to scan with the scene's scanner: NIfTI, NRRD, MHA, "
        'OME-Zarr, NPY/NPZ, raw, a TIFF stack or a DICOM folder',
    )
    parser.add_argument('--shape', type=int, nargs=3, metavar='N', help='voxels x y z of a raw --volume')
    parser.add_argument('--dtype', help='type of a raw --volume, such as uint8')
    spacing_argument(parser, '--volume')
    parser.add_argument(
        '--mu-water',
        type=float,
        metavar='MU',
        help='attenuation of water per mm. A --volume in HU becomes MU (1 + HU / 1000) per mm (default: HU are mapped to '
        'densities in [0, 1]). --units hu needs it, also for a --volume per mm',
    )
    parser.add_argument(
        '--units',
        choices=('1/mm', '1/cm', 'hu'),
        default='1/mm',
        help='unit of the written volume: attenuation per mm (default) or per cm, or Hounsfield units, with --mu-water',
    )


def spacing_argument(parser: argparse.ArgumentParser, of: str) -> None:
    """Add --spacing, the voxel size of the volume that the option `of` names."""
    parser.add_argument(
        '--spacing',
        type=float,
        nargs='+',
        metavar='MM',
        help=f'voxel size of a {of} whose file does not say it (.npy, .npz, raw, most TIFF), one number or x y z '
        '(default: 1 mm)',
    )


def check_input(args: argparse.Namespace) -> None:
    """Raises InputError if the arguments of `input_arguments` and --views contradict each other.

    A scan in the place of the scene becomes --projections, with a scanner that has no effects.
    """
    scene = Path(args.scene)
    if scene.suffix.lower() != '.xml' and args.scene not in scenes() and scene.exists():
        if args.projections or args.volume:
            raise InputError(
                f'{args.scene}: is not a scene, which --projections and --volume go with; leave one of them out'
            )
        args.projections, args.scene = args.scene, SCANNER
    for name in ('projections', 'volume', 'complete', 'start'):
        if getattr(args, name, None) == '':  # from an unset variable of the shell
            raise InputError(f'--{name} names no file')
    if args.views is not None and args.views < 1:
        raise InputError(f'--views must be at least 1, not {args.views}')
    if not args.volume and (args.shape or args.dtype or args.spacing):
        raise InputError('--shape, --dtype and --spacing go with --volume')
    if not args.volume and args.units != 'hu' and args.mu_water is not None:
        raise InputError('--mu-water goes with --volume, or with --units hu')
    unit_of(**units_of(args))
    if args.dtype and not _of_numbers(args.dtype):
        raise InputError(f'--dtype must be a NumPy type of real numbers, such as uint8, not {shown(args.dtype)}')
    if args.projections and args.volume:
        raise InputError('--projections and --volume exclude each other: measured views need no volume to scan')


def units_of(args: argparse.Namespace) -> dict[str, Any]:
    """The `units` and `mu_water` of what is written; --mu-water may belong to a --volume."""
    return dict(units=args.units, mu_water=args.mu_water if args.units == 'hu' else None)


def _of_numbers(dtype: str) -> bool:
    try:
        return np.dtype(dtype).kind in {*'buif'}
    except (TypeError, ValueError, SyntaxError):
        return False


def check_seed(seed: int, flag: str = '--seed') -> None:
    """Raises InputError for a --seed that not every generator of random numbers takes."""
    parsing.seed(seed, flag)


def read_input(args: argparse.Namespace, scene: Any, views: int | None, seed: int = 0, slab: int = 0) -> Any:
    """The `Dataset` that the arguments name: a file of projections, a volume scanned, or the scene's objects scanned.

    Parameters
    ----------
    scene
        The `LoadedScene` of args.scene.
    views : int or None
        How many evenly spaced views to use (None: all).
    seed : int
        Seed of the noise, if the scene's detector has any.
    slab : int
        Slices of the volume that are in memory at once (0: all; else there is no true volume).
    """
    from lingo_mi.files.scans import read_scan
    from lingo_mi.files.volumes import read_volume
    from lingo_mi.scene.checks import check_memory, thinned, warn_if_truncated
    from lingo_mi.scene.simulate import choose_views, take_scan, with_effects

    if args.projections:
        dataset = choose_views(with_effects(read_scan(args.projections), scene), views or 0)
        in_file = slab and dataset.train.stored is not None  # then only some views are in memory
        check_memory(thinned(dataset.train.geometry, slab), views=1 if in_file else 0)
        warn_if_truncated(dataset.train.geometry)
        return dataset
    volume = None
    if args.volume:
        # With --units hu, --mu-water may concern only the written volume.
        only_hu = args.units != 'hu'
        volume = read_volume(args.volume, args.mu_water, args.shape, args.dtype, args.spacing, only_hu=only_hu)
    return take_scan(scene, views or 0, volume, seed, truth=not slab)


def check_scan_output(
    out: Path, inputs: Iterable[PathLike | str | None], force: bool, endings: tuple[str, ...] = ('.npy',)
) -> None:
    """Raises InputError unless a scan can be written to `out` and beside it, over none of the files that are read.

    Parameters
    ----------
    force : bool
        Whether other files may be overwritten; a .zarr must be new.
    endings : tuple of str
        That the name may have.
    """
    from lingo_mi.files.scans import written_files

    if out.suffix not in endings:
        kinds = ' or '.join(endings)
        raise InputError(f'{out}: a scan is written as {kinds} with a .yml beside it; give a name that ends in {kinds}')
    if out.suffix == '.zarr':
        require_new_folder(out)
    written = written_files(out)
    for source in filter(None, inputs):
        if Path(source).resolve() in [file.resolve() for file in written]:
            raise InputError(f'{source}: would be overwritten by {out} or a file beside it; give --out another name')
    for file in written:
        if file.exists() and not force:
            raise InputError(f'{file}: exists already; give --force to overwrite it')
    require_writable(out.parent, out, 'choose another --out')


def cluster_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --cluster and --threads; see `runner_of`."""
    parser.add_argument(
        '--cluster',
        metavar='ADDRESS|local:N',
        help="work on a Dask cluster: its scheduler's address or file, or N processes of this machine (default: in this process)",
    )
    parser.add_argument(
        '--threads',
        type=int,
        default=0,
        metavar='N',
        help='CPU threads of a worker (default: all that it has; with local:N, its share)',
    )


def check_threads(args: argparse.Namespace) -> None:
    """Raises InputError for --threads below 1, or without --cluster."""
    if args.threads < 0:
        raise InputError(f'--threads must be at least 1, not {args.threads}')
    if args.threads and args.cluster is None:
        raise InputError('--threads goes with --cluster')


@contextmanager
def runner_of(args: argparse.Namespace, folder: Path) -> Iterator[Any]:
    """Return the runner of jobs that the arguments of `cluster_arguments` choose: this process, or a cluster that is open in
    the block.

    Parameters
    ----------
    folder : Path
        An existing folder that all workers must see.

    Raises
    ------
    InputError
        If --cluster leads nowhere.
    """
    from lingo_mi.jobs.in_process import InProcess

    check_threads(args)
    if args.cluster is None:
        yield InProcess()
        return
    from lingo_mi.jobs.cluster import opened

    with opened(args.cluster, folder, args.threads, args.variant) as cluster:
        print(f'dashboard: {cluster.dashboard}', file=sys.stderr)
        yield cluster


def docs_arguments(parser: argparse.ArgumentParser, document: str, figures: str) -> None:
    """Add the arguments that say which documentation to update: --docs, --document, --figures; see `docs_of`.

    Parameters
    ----------
    document, figures : str
        Places of the Markdown page and of the folder of pictures in the folder --docs, unless named.
    """
    parser.add_argument(
        '--docs', type=Path, metavar='DIR', help='update the documentation in DIR (default: nothing outside --out)'
    )
    parser.add_argument(
        '--document',
        type=Path,
        metavar='FILE',
        help=f'Markdown page whose tables to update, between <!-- table NAME --> and <!-- end NAME --> '
        f'(default: {document} in --docs)',
    )
    parser.add_argument(
        '--figures', type=Path, metavar='DIR', help=f'folder of the pictures (default: {figures} in --docs, else --out)'
    )
    parser.set_defaults(in_docs=(document, figures))


def docs_of(args: argparse.Namespace) -> tuple[Path | None, Path]:
    """The page to update, if any, and the folder of the pictures, of the arguments that `docs_arguments` added.

    Raises
    ------
    InputError
        If --docs is not a folder, or if the results in --out might overwrite the page.
    """
    document, figures = args.document, args.figures or args.out
    if args.docs is not None:
        if not args.docs.is_dir():
            raise InputError(f'--docs {args.docs}: there is no such folder')
        document, figures = args.document or args.docs / args.in_docs[0], args.figures or args.docs / args.in_docs[1]
    if document and document.resolve().parent == args.out.resolve():
        raise InputError(
            f'--out {args.out}: is the folder of {document}, which results could overwrite; choose another'
        )
    return document, figures


def definitions(pairs: Iterable[str]) -> dict[str, str]:
    """The NAME=VALUE arguments of -D as a dictionary."""
    out = {}
    for pair in pairs:
        name, equals, value = pair.partition('=')
        if not equals or not name:
            raise InputError(f'-D {pair}: write it as name=value')
        out[name] = value
    return out
