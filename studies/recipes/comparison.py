"""Comparison of methods: quality of fits against time for some scenes, as curves and as a Markdown table.

Each fit is a separate process, `lingo-mi fit`, in a folder named after its options. A fit with a result is not run again; an
interrupted one continues.

    comparison = Comparison(Path('out/recipes'), views=25, iterations=5000)
    results = comparison.results(['x3d_foot'], ['fast', 'lingo:V_S=1'])
    print(recipe_table(results))
    draw(results, Path('out/recipes/recipes.png'))
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from urllib.parse import quote

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.methods.by_name import changes_of, method_of
from lingo_mi.scene.shipped import scene_path
from lingo_mi.storage.file_access import read_object, replacing, write_text

Results = dict[tuple[str, str], dict]  # (scene, method) -> the metrics of the fit

# metric -> title, format
COLUMNS = dict(
    psnr_2d=('views, dB', '{:.2f}'),
    psnr_2d_r2=('views (R2), dB', '{:.2f}'),
    ssim_2d_r2=('SSIM', '{:.4f}'),
    psnr_3d_r2=('volume, dB', '{:.2f}'),
    ssim_3d_r2=('SSIM 3D', '{:.4f}'),
    ipsd=('IPSD', '{:.4f}'),
    ipsd_targets=('born', '{:,}'),
    gaussians=('Gaussians', '{:,}'),
    iterations=('iterations', '{}'),
    seconds_init=('start, s', '{:.1f}'),
    seconds_fit=('fit, s', '{:.0f}'),
)

LONGEST = 200  # characters of a folder's name before it is cut; file systems allow 255


@dataclass(frozen=True)
class Comparison:
    """Properties that the fits of a comparison share.

    Parameters
    ----------
    folder : Path
        The folder of their folders.
    views : int
        Fitted.
    iterations : int
        Iterations of all methods but `fast`, which keeps its own number, and those that name it themselves.
    changes : tuple[str, ...]
        'name=value', options of every fit or parameters of its scene.
    """

    folder: Path
    views: int = 25
    iterations: int = 5000
    changes: tuple[str, ...] = ()

    def results(self, scenes: Iterable, methods: Iterable[str]) -> Results:
        """The metrics of all fits; those that are missing are run first.

        Parameters
        ----------
        scenes : Iterable
            Files of scenes, or names of shipped ones.
        methods : Iterable[str]
            Names of METHODS, or `name:option=value,...`.

        Raises
        ------
        InputError
            For an unknown method, before any fit, and where a fit fails.
        """
        methods = list(methods)
        for method in methods:
            method_of(method)
        scenes = list(scenes)
        names = [Path(scene).stem for scene in scenes]
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f'{twice[0]}: two scenes have this name, by which results are told apart; rename one')
        return {(Path(scene).stem, method): self.result(scene, method) for scene in scenes for method in methods}

    def result(self, scene: PathLike | str, method: str) -> dict:
        """The metrics of one fit, run now unless they are there."""
        folder, command = self.plan(scene, method)
        self._require_same_scene(folder, scene)
        if not (folder / 'metrics.json').exists():
            if (folder / 'checkpoint.npz').exists():
                command.append('--resume')
            print(' '.join(command), file=sys.stderr)
            if code := run_command(command):
                raise InputError(f'{scene}: lingo-mi fit --method {method} failed with exit code {code}')
        return read_object(folder / 'metrics.json')

    def _require_same_scene(self, folder: Path, scene: PathLike | str) -> None:
        try:
            digest = hashlib.sha256(scene_path(scene).read_bytes()).hexdigest()
        except (InputError, OSError):  # the fit will say so
            return
        path = self.folder / 'scenes.json'
        stored = read_object(path) if path.exists() else {}
        if folder.exists() and stored.get(folder.name, digest) != digest:
            raise InputError(f'{folder}: has the fit of another scene of this name; choose another --out, or remove it')
        self.folder.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(stored | {folder.name: digest}, indent=1) + '\n')

    def plan(self, scene: PathLike | str, method: str) -> tuple[Path, list[str]]:
        """The folder of a fit, and the command that fills it."""
        name, _, setting = method.partition(':')
        changes = [*self.changes, *changes_of(setting)]
        if name != 'fast' and not any(change.startswith('iterations=') for change in changes):
            changes.append(f'iterations={self.iterations}')
        parts = [Path(scene).stem, str(self.views), name, *changes]
        title = quote('_'.join(parts), safe='=,:+ ')  # a value may be a path
        if len(title) > LONGEST:
            title = title[:LONGEST] + '_' + hashlib.sha256(title.encode()).hexdigest()[:12]
        folder = self.folder / title
        program = [sys.executable, '-m', 'lingo_mi', 'fit', str(scene)]
        options = ['--method', name, '--views', str(self.views), '--out', str(folder)]
        return folder, program + options + [word for change in changes for word in ('-D', change)]


def run_command(command: list[str]) -> int:
    """Run a command to its end; its exit code. Ctrl-C, which reaches it, too, waits until it has stored where it is."""
    process = subprocess.Popen(command)
    try:
        return process.wait()
    except KeyboardInterrupt:
        try:
            process.wait()
        except KeyboardInterrupt:  # a second one
            process.kill()
        raise KeyboardInterrupt('the same command goes on from here') from None


def recipe_table(results: Results) -> str:
    """The Markdown table."""
    lines = [
        '| scene | method | ' + ' | '.join(title for title, _ in COLUMNS.values()) + ' |',
        '|---|---|' + '---:|' * len(COLUMNS),
    ]
    for (scene, method), metrics in results.items():
        cells = (form.format(metrics[k]) if metrics[k] is not None else '–' for k, (_, form) in COLUMNS.items())
        lines.append(f'| {scene} | {method} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines)


def draw(results: Results, figure: Path) -> None:
    """The picture of all histories: PSNR of held-out views and of the volume against seconds, a column a scene."""
    from matplotlib.figure import Figure  # half a second that the fits need not wait for

    scenes = list(dict.fromkeys(scene for scene, _ in results))
    fig = Figure(figsize=(5 * len(scenes), 7), layout='constrained')
    axes = fig.subplots(2, len(scenes), squeeze=False)
    for (scene, method), metrics in results.items():
        for row, (key, what) in enumerate(dict(psnr_2d='held-out views', psnr_3d_r2='volume').items()):
            axis = axes[row, scenes.index(scene)]
            points = [(e['seconds'], e[key]) for e in metrics['history'] if e.get(key) is not None]
            if not points:  # 3dgs and xgaussian make no volume
                continue
            axis.semilogx(*zip(*points), '.-', label=f'{method}, {metrics["iterations"]} iterations')
            axis.set(title=scene if row == 0 else None, xlabel='time in steps [s]', ylabel=f'PSNR, {what} [dB]')
            axis.grid(alpha=0.3, which='both')
            axis.legend()
    figure.parent.mkdir(parents=True, exist_ok=True)
    with replacing(figure) as temporary:
        fig.savefig(temporary, dpi=90)
