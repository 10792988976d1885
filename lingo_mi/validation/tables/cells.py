"""The paper's tables as cells: fits of sparse scans, and reconstructions from completed scans, each stored when it is done.

A cell is one fit, or one CT volume, of one object from one number of views. It is a JSON file, written atomically, in a folder
named after its method and a hash of all options. A stored cell is not computed again; other options make another cell. A fit
stores its checkpoint next to it. The checkpoint has three uses: to continue after an interruption, to start the next longer fit
of the same method, and to render the missing views for a CT volume.

Every object is scanned as in X3D's scenes (`phantoms.x3d_scan`): 50 views over half a turn and 50 held-out views. A fit uses a
few evenly spaced ones of the former. For a CT volume, the fitted views are completed to 100.
"""

from __future__ import annotations

import functools
import hashlib
import json
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.interrupts import between_steps
from lingo_mi.common.progress import Progress
from lingo_mi.completion.views import insert_views
from lingo_mi.files.scans import read_scan
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.fit import Fit as Fitted
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.measure import fit_metrics
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.by_name import method_of
from lingo_mi.metrics import quality as metrics
from lingo_mi.phantoms.x3d_scan import scan
from lingo_mi.reconstruction import ASDPOCS, FDK, SART, Best, Refined, progress_bar
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.simulate import choose_views
from lingo_mi.storage.file_access import replacing
from lingo_mi.storage.output_folder import CHECKPOINT
from lingo_mi.validation.provenance import provenance
from lingo_mi.validation.tables.objects import averaged, load_object, scan_digest, scans_in
from lingo_mi.validation.tables.photons import LARGEST, counting, noisy
from lingo_mi.validation.tables.record import Record

SCANNED, COMPLETED = 50, 100  # views of a scan; views that a CT volume is made of
R2_ERROR = 0.15  # maxl2err of asd-pocs-r2, over the norm of its views
LATER = {'fit_pixels': 'off'}  # settings that are newer than published cells, and their values in these
NEW_VIEWS, CT = ('psnr_2d_r2', 'ssim_2d_r2', 'ipsd'), ('psnr_3d_r2', 'ssim_3d_r2')  # of a fit's views; of a volume

# How each volume is made, and the passes over all views (R2-Gaussian's comparison; the rest are TIGRE's defaults, and in
# sart-r2 and asd-pocs-r2 what R2-Gaussian has released).
ALGORITHMS = {
    'fdk': FDK(),
    'sart': SART(niter=20),
    'asd-pocs': ASDPOCS(niter=10),
    'sart-r2': SART(niter=20, lmbda_red=0.999),
    'asd-pocs-r2': ASDPOCS(niter=10, lmbda_red=0.9999, rmax=0.94),
    'refined': Refined(),
    'finer': Refined(finer=2, completed_niter=0, niter=4),
    'best': Best(),
}


@dataclass(frozen=True)
class Scale:
    """Sizes of the objects and fits of the tables.

    Parameters
    ----------
    size : int
        Voxels along an object's longest side, at most; larger volumes are averaged down.
    pixels : int
        Along a side of the panel.
    n_points : int
        Gaussians that a fit starts with.
    iterations : tuple[int, ...]
        Iterations of the fits, if the user names none.
    objects : tuple[str, ...]
        If the user names none.
    finer : int
        How many times as many voxels are scanned along each side, if the object has them: the projections then hold structure
        that the reconstructed voxels cannot.
    photons : float
        A pixel in the open beam, by which the views to fit are measured; 0: without noise.
    electronic_noise : float
        Electronic noise of the detector, standard deviation in photons.
    longest : float
        Line integral of a scan, to which its density is scaled when photons are counted.
    first : bool
        Whether the views to fit are the first ones of the scan, as in the released code of X-Gaussian and SAX-NeRF, instead of
        evenly spaced ones.
    data : str
        Folder of scans that take the place of the objects, see `objects.scans_in`; '': objects are scanned.
    """

    size: int
    pixels: int
    n_points: int
    iterations: tuple[int, ...]
    objects: tuple[str, ...]
    finer: int = 1
    photons: float = 0.0
    electronic_noise: float = 0.0
    longest: float = LARGEST
    first: bool = False
    data: str = ''

    @property
    def shrink(self) -> float:
        """The factor by which these volumes are smaller than the paper's, along a side."""
        return 1.0 if self.data else self.size / PAPER_SIZE


PAPER_SIZE = 256
# An object of 3/8 of the size in every length has 1/7 of the surface, and so 1/7 of the Gaussians. V_S is made smaller, too, so
# that cells have the paper's size in parts of the object.
SCALES = {
    'small': Scale(96, 192, 7000, (5000,), ('foot', 'chest', 'engine', 'aneurism')),
    'paper': Scale(
        PAPER_SIZE,
        512,
        50_000,
        (5000, 15_000, 30_000),
        ('foot', 'chest', 'engine', 'aneurism', 'chest_lidc0314', 'head_fsrt'),
    ),
}


@dataclass(frozen=True)
class Fit:
    """A cell: a cloud fitted to some views of an object.

    Parameters
    ----------
    method : str
        A name of METHODS, or `name:option=value,...`.
    iterations : int or None
        Adam steps; None: the method's own.
    """

    object: str
    views: int
    method: str
    iterations: int | None = None

    def __str__(self):
        return f'{self.object}, {self.views} views, {self.method}'


@dataclass(frozen=True)
class Volume:
    """A cell: a CT volume by one of ALGORITHMS, from the views of `fit`, completed from its cloud.

    If the fit's method is 'none', from these views alone; 'refined' and 'finer' start from the cloud's own volume.
    """

    fit: Fit
    algorithm: str

    def __str__(self):
        return f'{self.fit}, {self.algorithm}'


def method_for(fit: Fit, scale: Scale) -> Method:
    """The method of a fit, with the scale's number of Gaussians and voxel scaling if the fit does not name them."""
    method = method_of(fit.method)
    if 'n_points' in method.flat() and 'n_points=' not in fit.method:
        method = method.changed(n_points=scale.n_points)
    if 'V_S' in method.flat() and 'V_S=' not in fit.method:
        method = method.changed(V_S=method.flat()['V_S'] * scale.shrink)
    return method if fit.iterations is None else method.changed(iterations=fit.iterations)


class Cells:
    """The cells of one scale and seed below a folder."""

    def __init__(
        self, folder: Path, scale: Scale, seed: int = 0, command: str | None = None, record: Record | None = None
    ):
        """command: to be kept with the cells, None: this process's; record: has the numbers of cells without their files."""
        self.folder, self.scale, self.seed, self.command = Path(folder), scale, seed, command
        self.record = record
        self.dataset = functools.lru_cache(1)(self._dataset)
        self._cloud = functools.lru_cache(1)(self._cloud)
        self._completed = functools.lru_cache(1)(self._completed)

    def path(self, cell: Fit | Volume) -> Path:
        """The file of a cell."""
        fit = cell.fit if isinstance(cell, Volume) else cell
        if self.scale.data:
            of_scan = dict(scan=scan_digest(scans_in(Path(self.scale.data))[fit.object]), seed=self.seed)
        else:
            of_scan = dict(
                size=self.scale.size, finer=self.scale.finer, pixels=self.scale.pixels, scanned=SCANNED, seed=self.seed
            )
        if self.scale.first:
            of_scan['first'] = True
        if self.scale.photons:
            of_scan |= {name: getattr(self.scale, name) for name in ('photons', 'electronic_noise', 'longest')}
        where = self.folder / fit.object / f'{fit.views}_views'
        if isinstance(cell, Volume):
            options = dict(algorithm=ALGORITHMS[cell.algorithm].options, completed=COMPLETED)
            if fit.method == 'none':
                return self.folder_of(fit) / f'{cell.algorithm}_{_hash(of_scan | options)}.json'
            return self.path(fit).parent / f'{cell.algorithm}_{_hash(options)}.json'
        settings = method_for(fit, self.scale).flat()
        del settings['checkpoint_seconds']
        iterations = settings.pop('iterations')
        settings = {name: value for name, value in settings.items() if LATER.get(name, ...) != value}
        return where / f'{fit.method.replace(":", "_")}_{_hash(of_scan | settings)}' / str(iterations) / 'fit.json'

    def folder_of(self, fit: Fit) -> Path:
        """The folder of all fits of a method to the views of an object, and of the volumes made of them."""
        if fit.method == 'none':
            return self.folder / fit.object / f'{fit.views}_views' / 'none'
        return self.path(fit).parents[1]

    def get(self, cell: Fit | Volume) -> dict | None:
        """The numbers of a cell, from its file or the record; None if it is in neither, or damaged."""
        needed = CT if isinstance(cell, Volume) else ('seconds_init', *NEW_VIEWS, *CT)
        try:
            numbers = json.loads(self.path(cell).read_text(encoding='utf-8'))
        except (OSError, ValueError):
            numbers = None
        if not (isinstance(numbers, dict) and numbers.keys() >= set(needed)):
            numbers = None if self.record is None else self.record.get(self._key(cell))
        return numbers if numbers and numbers.keys() >= set(needed) else None

    def record_all(self, cells: Iterable[Fit | Volume]) -> None:
        """Add the stored ones of the cells to the record."""
        if self.record is not None:
            self.record.add({self._key(cell): numbers for cell in cells if (numbers := self.get(cell)) is not None})

    def _key(self, cell: Fit | Volume) -> str:
        return self.path(cell).relative_to(self.folder).as_posix()

    def compute(self, cell: Fit | Volume, label: str, report: Callable[..., None] | None = None) -> dict:
        """Compute and store a cell, with a progress bar called `label`; a Volume's fit must be stored already.

        Parameters
        ----------
        report : callable or None
            Called between the steps of a fit, with their number, beside the bar.

        Raises
        ------
        InputError
            If it cannot be computed, and KeyboardInterrupt, after which a fit goes on where it was.
        """
        path = self.path(cell)
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(cell, Fit):
            fit, numbers = cell, self._fit(cell, path, label, report)
        else:
            fit, numbers = cell.fit, self._volume(cell, path, label)
        numbers |= dict(
            object=fit.object,
            views=fit.views,
            seed=self.seed,
            scale=asdict(self.scale),
            variant=mi.variant(),
            provenance=provenance(self.command),
        )
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(numbers, indent=1, default=np.generic.item) + '\n', encoding='utf-8')
        return numbers

    def compute_missing(self, planned: list[Fit | Volume], after_each: Callable[[], object]) -> dict:
        """Compute the planned cells that are not stored, one by one, and return the errors of failed ones by cell.

        Raises KeyboardInterrupt, which says that the same command goes on.
        """
        missing, failed = [cell for cell in planned if self.get(cell) is None], {}
        try:
            for i, cell in enumerate(missing, 1):
                try:
                    self.compute(cell, f'[{i}/{len(missing)}] {cell}')
                except InputError as error:  # one cell failed: the others are worth having
                    failed[cell] = error
                after_each()
        except KeyboardInterrupt:
            raise KeyboardInterrupt('the same command goes on from here') from None
        return failed

    def _dataset(self, name: str) -> Dataset:
        if self.scale.data:
            return read_scan(scans_in(Path(self.scale.data))[name])
        scanned = load_object(name, self.scale.size * self.scale.finer)
        with Progress(f'Scan of {name}', 2 * SCANNED) as bar:
            dataset = scan(scanned, SCANNED, self.seed, lambda done, _: bar.update(done), self.scale.pixels)
        truth = averaged(scanned, self.scale.size)
        assert dataset.test is not None  # of a simulated scan
        return Dataset(self._counted(dataset.train.on(truth.grid)), dataset.test.on(truth.grid), truth.data)

    def _counted(self, scan: Scan) -> Scan:
        """The views as the scale's detector measures them."""
        if not self.scale.photons:
            return scan
        unit = self.scale.longest / scan.projections.max()
        detector = counting(self.scale.photons, self.scale.electronic_noise)
        return replace(scan, projections=noisy(scan.projections * unit, detector, self.seed) / unit)

    def _measured(self, fit: Fit) -> Dataset:
        dataset = self.dataset(fit.object)
        if self.scale.first:
            return replace(dataset, train=dataset.train.subset(np.arange(fit.views)))
        return choose_views(dataset, fit.views)

    def _fit(self, cell: Fit, path: Path, label: str, report: Callable[..., None] | None = None) -> dict:
        dataset, method, saved = self._measured(cell), method_for(cell, self.scale), path.with_name(CHECKPOINT)
        if (path.exists() or saved.exists()) and _iterations(saved) is None:
            print(f'{saved}: is missing or damaged, so {cell} is fitted again', file=sys.stderr)
        self._begin(method, saved)
        resume = _iterations(saved) is not None
        with Progress(label, method.iterations) as bar, between_steps() as check:

            def progress(iteration, **fields):
                bar.update(iteration, **fields)
                check()
                if report is not None:
                    report(iteration)

            fitted = run(dataset.train, method, self.seed, progress=progress, path=saved, resume=resume)
        return fit_metrics(fitted.with_data(dataset)) | dict(
            method=cell.method, settings=method.flat(), initial=fitted.info
        )

    def _begin(self, method: Method, saved: Path):
        """Without a whole checkpoint, copy the one of the longest shorter fit of the same method, if its steps are ours."""
        if not method.extensible or _iterations(saved) is not None:
            return
        done = sorted(int(path.parent.name) for path in saved.parents[1].glob('*/fit.json'))
        shorter = [saved.parents[1] / str(n) / CHECKPOINT for n in done if n < method.iterations]
        whole = next((path for path in reversed(shorter) if _iterations(path) is not None), None)
        if whole is not None:
            Checkpoint.load(whole).save(saved)

    def _cloud(self, fit: Fit) -> Fitted:
        """A stored fit; without its whole checkpoint, it is fitted again."""
        method, saved = method_for(fit, self.scale), self.path(fit).with_name(CHECKPOINT)
        if _iterations(saved) != method.iterations:  # fewer where fitting it again was interrupted
            self.compute(fit, f'{fit}, again')
        return run(self._measured(fit).train, method, self.seed, path=saved, resume=True)

    def _completed(self, fit: Fit) -> Scan:
        """The fitted views, completed from the cloud."""
        return insert_views(self._measured(fit).train, COMPLETED, self._cloud(fit).render)

    def _volume(self, cell: Volume, path: Path, label: str) -> dict:
        algorithm = ALGORITHMS[cell.algorithm]
        inputs: dict[str, Any] = {}
        if cell.fit.method != 'none' and self.get(cell.fit) is None:
            raise InputError('there is no fit to complete the views from')
        dataset = self._measured(cell.fit)
        if dataset.volume is None:
            raise InputError('there is no true volume to compare with')
        views = dataset.train if cell.fit.method == 'none' else self._completed(cell.fit)
        if isinstance(algorithm, Refined):
            inputs = dict(completed=views, sample=self._cloud(cell.fit).volume)
            views = dataset.train
        if cell.algorithm == 'asd-pocs-r2':
            algorithm = replace(algorithm, maxl2err=R2_ERROR * float(np.linalg.norm(views.projections)))
        with progress_bar(algorithm, views, label) as progress:
            result = run_algorithm(views, algorithm, progress=progress, **inputs)
        return dict(
            algorithm=cell.algorithm,
            options=algorithm.options,
            method=cell.fit.method,
            seconds=result.seconds,
            psnr_3d_r2=metrics.psnr_3d_r2(result.volume, dataset.volume),
            ssim_3d_r2=metrics.ssim_3d_r2(result.volume, dataset.volume),
        )


def _iterations(path: Path) -> int | None:
    """Return the iterations that the fit of a checkpoint has done, or None if the file is missing or damaged."""
    try:
        return Checkpoint.load(path).iteration
    except InputError:
        return None


def _hash(values: dict) -> str:
    return hashlib.sha1(json.dumps(values, sort_keys=True).encode()).hexdigest()[:8]
