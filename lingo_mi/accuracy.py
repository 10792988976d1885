"""What accuracy costs: error, time and memory of every way to compute the same projections, and of fits.

`measure` runs it all on fixed seeds in this process and gives plain numbers; `accuracy_report` makes tables and plots
of them.

Errors are relative to `closed_form`, in float64: |found - expected| / |expected| in the L2 norm, and the largest
deviation over the largest expected value. Derivatives are those of sum(weights * image) with fixed normal weights, so
that the sums cancel as a residual's do. Times are medians over rounds in which the methods of a table take turns, so
that all see the same machine.
"""
from __future__ import annotations

import gc
import platform
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np

from . import phantoms
from .closed_form import NAMES, image_and_gradients
from .fit.device import DeviceState
from .fit.initial import initial_cloud
from .fit.loop import run
from .fit.settings import METHODS, VOLUMETRIC
from .fit.state import start
from .fit.step import Stepper
from .geometry import Geometry, circular
from .phantoms.scanning import simulate
from .results import quick_measure
from .scan import Dataset, Scan
from .xray import alternatives, balance, grid, splat
from .xray.footprint import project
from .xray.frame import View, vector64
from .xray.voxelize import Grid, voxelize

DSO, DSD, PANEL = 7.8125, 11.71875, 4.   # X3D's scanner, in units of half the volume's side
BALL = .625                             # radius of the ball of centres
SPREAD = 1.16                           # mean of a box's side over that of a Gaussian of the median scale
EPSILONS = 1e-3, 1e-4, 1e-5
EXTENT = 5.


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    gaussians, pixels, box   the cloud, the side of its square panel, mean pixels in a box of 3 standard deviations
    few                      Gaussians of the same kind where slow methods take part
    grids                    voxels along a side of the grids
    rounds, seconds          repeats of a method, fewer once it has taken so long altogether
    pairs, counts, panels    the three sweeps: pairs of a pixel and a Gaussian, Gaussians, pixels along a side
    phantoms                 voxels and pixels along a side of the fits' phantom
    points                   Gaussians a fit starts with
    iterations               of a fit
    views                    of a fit, and as many held out
    """

    gaussians: int = 20_000
    few: int = 4_000
    pixels: int = 512
    box: float = 234.
    grids: tuple = (64, 128, 256)
    rounds: int = 9
    seconds: float = 6.
    pairs: tuple = (1e4, 1e5, 1e6, 1e7, 1e8)
    counts: tuple = (100, 1_000, 10_000, 100_000, 1_000_000)
    panels: tuple = (64, 128, 256, 512, 1024, 2048)
    phantoms: tuple = (64, 128)
    points: tuple = (1_000, 4_000, 16_000)
    iterations: tuple = (150, 400, 1_000)
    views: int = 25


FULL = Sizes()
QUICK = Sizes(gaussians=4_000, few=1_000, pixels=256, grids=(64, 128), rounds=5, seconds=.7, pairs=(1e4, 1e5, 1e6, 1e7),
              counts=(100, 1_000, 10_000, 100_000), panels=(64, 256, 1024), phantoms=(64,), points=(1_000, 4_000),
              iterations=(50, 150), views=16)


def measure(sizes: Sizes, progress=None) -> dict:
    """All measurements, as numbers and strings for JSON.

    progress   called as progress(what) before each part
    """
    work, few = (Workload(n, sizes.pixels, sizes.box) for n in (sizes.gaussians, sizes.few))
    parts = dict(cutoff=lambda: cutoff(work, sizes), footprint=lambda: footprint(work, sizes),
                 methods=lambda: methods(few, sizes), marching=lambda: marching(few, sizes), pixel=lambda: pixel(sizes),
                 teams=lambda: teams(work, sizes), scaling=lambda: scaling(sizes),
                 initialisations=lambda: initialisations(sizes), fits=lambda: fits(sizes))
    out = dict(conditions=dict(variant=mi.variant(), threads=dr.thread_count(), machine=machine(), sizes=asdict(sizes)))
    for name, part in parts.items():
        if progress:
            progress(name)
        out[name] = part()
    return out


def machine() -> str:
    """The processor's name, as far as the system tells."""
    try:
        return next(line.split(':')[1].strip() for line in open('/proc/cpuinfo') if line.startswith('model name'))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


# ------------------------------------------------------------------------------------------------------------
#  The cloud
# ------------------------------------------------------------------------------------------------------------

class Workload:
    """A random cloud before a scanner: as arrays, as a scene, and as float64 truth.

    order   of the Gauss-Legendre rule for pixel means; 0 for the rays through pixel centres
    """

    def __init__(self, gaussians: int, pixels: int, box: float, order: int = 0, mode: str = 'cone'):
        rng = np.random.default_rng(0)
        n = gaussians
        sigma = np.sqrt(box) / 6 / SPREAD * (PANEL / pixels) * DSO / DSD
        direction = rng.normal(size=(n, 3))
        centre = direction / np.linalg.norm(direction, axis=1, keepdims=True) * BALL * rng.random((n, 1)) ** (1 / 3)
        rotation = rng.normal(size=(n, 4))
        rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
        columns = centre, sigma * np.exp(rng.normal(0, .35, (n, 3))), rotation, rng.uniform(.1, 1, n)
        self.columns = [x.astype(np.float32) for x in columns]
        self.pixels, self.order = pixels, order
        self.weights = rng.normal(size=(pixels, pixels)).astype(np.float32)
        self.geometry = Geometry(DSO, DSD, pixels, PANEL / pixels, 8, 1 / 4, [.4], mode=mode)
        self.view = View.of(self.geometry.frames(), 0, pixels, pixels)
        self.data = mi.TensorXf(np.concatenate(self.columns[:3], 1))
        self.density = mi.TensorXf(self.columns[3][:, None])
        self.scene = mi.load_dict(dict(
            type='scene', cloud=dict(type='ellipsoids', data=self.data, density=self.density),
            scanner=dict(type='ct_scanner', mode=mode, DSO=DSO, DSD=DSD, nDetector=str(pixels), nVoxel='8',
                         dVoxel='.25', dDetector=repr(PANEL / pixels), angles=repr(float(np.degrees(.4))))))
        self._truth = None

    @property
    def truth(self):
        """The image [v, u] and the derivatives by name."""
        if self._truth is None:
            self._truth = image_and_gradients(self.columns, self.geometry.frames(), (self.pixels,) * 2, self.weights,
                                              self.order)
        return self._truth

    def gaussians(self):
        """Centre, scale, rotation and density as new Dr.Jit arrays."""
        kinds = mi.Point3f, mi.Vector3f, mi.Vector4f
        return [*(kind(*(mi.Float(c) for c in x.T)) for kind, x in zip(kinds, self.columns)), mi.Float(self.columns[3])]

    def pairs(self, extent: float) -> float:
        """Pixels in the bounding boxes of all footprints."""
        f = project(*self.gaussians(), self.view, extent)
        return float(dr.sum(dr.float64_array_t(mi.Float)(mi.Float(f.row_end - f.row_begin) * f.width))[0])


# ------------------------------------------------------------------------------------------------------------
#  Methods, and what is measured of them
# ------------------------------------------------------------------------------------------------------------

@dataclass
class Method:
    """One way to compute a workload's image.

    image       () -> Float [pixels], evaluated
    gradients   () -> the four derivatives, Dr.Jit arrays or tuples of them, evaluated, forward pass included; or None
    """

    name: str
    image: object
    gradients: object = None
    times: dict = field(default_factory=lambda: dict(forward=[], gradients=[]))


def by_function(name, work: Workload, function, differentiable=True) -> Method:
    """A method from function(centre, scale, rotation, density) -> Float [pixels]."""
    def image():
        out = function(*work.gaussians())
        dr.eval(out)
        return out

    def gradients():
        leaves = work.gaussians()
        dr.enable_grad(leaves)
        dr.backward_from(function(*leaves) * mi.Float(work.weights.ravel()))
        out = [dr.grad(x) for x in leaves]
        dr.eval(out)
        return out
    return Method(name, image, gradients if differentiable else None)


def by_integrator(name, work: Workload, around=None, **settings) -> Method:
    """A method from `lingo_xray` with these parameters, through `mi.render` and `dr.backward`.

    around   a context manager, made anew for every call
    """
    integrator = mi.load_dict(dict(type='lingo_xray', **settings))
    params = mi.traverse(work.scene)
    weights = mi.TensorXf(work.weights[..., None])
    around = around or _nothing

    def image():
        with around():
            out = mi.render(work.scene, integrator=integrator).array
            dr.eval(out)
        return out

    def gradients():
        keys = 'cloud.data', 'cloud.density'
        for key in keys:
            dr.enable_grad(params[key])
            dr.set_grad(params[key], 0)
        with around():
            dr.backward(mi.render(work.scene, params, integrator=integrator) * weights)
        out = [dr.grad(params[key]) for key in keys]
        dr.eval(out)
        for key in keys:
            dr.disable_grad(params[key])
        return _split(*out)
    return Method(name, image, gradients)


@contextmanager
def _nothing():
    yield


def _split(data, density):
    """Derivatives by the four parameters from those by the rows of `ellipsoids`."""
    data = data.numpy().reshape(-1, 10)
    return data[:, :3].T, data[:, 3:6].T, data[:, 6:].T, density


def compare(work: Workload, list_of_methods, sizes: Sizes) -> list[dict]:
    """Errors, times and memory of methods, one dictionary each."""
    rows = []
    image, gradients = work.truth
    for m in list_of_methods:  # the first calls, which compile
        row = dict(name=m.name)
        found, row['memory_mb'] = peak_memory(m.image)
        row['image'], row['image_max'] = deviation(np.array(found), image)
        if m.gradients:
            found, row['memory_gradients_mb'] = peak_memory(m.gradients)
            for key, by in zip(NAMES, found):
                row[key], row[f'{key}_max'] = deviation(np.array(by).T, gradients[key])
        rows.append(row)
    take_turns(list_of_methods, sizes)
    for m, row in zip(list_of_methods, rows):
        row.update(statistics(m.times))
    return rows


def deviation(found, expected) -> tuple[float, float]:
    """Relative L2 and maximum error."""
    found, expected = np.ravel(np.asarray(found, float)), np.ravel(expected)
    error = found - expected
    return (float(np.linalg.norm(error) / np.linalg.norm(expected)), float(abs(error).max() / abs(expected).max()))


def take_turns(list_of_methods, sizes: Sizes):
    """Time all methods in turn, round by round."""
    for _ in range(sizes.rounds):
        for m in list_of_methods:
            for key, function in dict(forward=m.image, gradients=m.gradients).items():
                if function and sum(m.times[key]) < sizes.seconds:
                    m.times[key].append(seconds(function))


def seconds(function) -> float:
    dr.sync_thread()
    begun = time.perf_counter()
    function()
    dr.sync_thread()
    return time.perf_counter() - begun


def statistics(times: dict) -> dict:
    """Median and quartiles in ms, by what was timed."""
    out = {}
    for key, values in times.items():
        if values:
            out[f'{key}_ms'] = 1e3 * float(np.median(values))
            out[f'{key}_quartiles_ms'] = [1e3 * float(q) for q in np.quantile(values, (.25, .75))]
            out[f'{key}_repeats'] = len(values)
    return out


def peak_memory(function):
    """What a call gives, and the MB that Dr.Jit holds at most during it, above what it held before."""
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    backend = dr.backend_v(mi.Float)
    before = dr.detail.malloc_watermark(backend)
    out = function()
    dr.sync_thread()
    return out, (dr.detail.malloc_watermark(backend) - before) / 1e6


# ------------------------------------------------------------------------------------------------------------
#  Images: one function a table
# ------------------------------------------------------------------------------------------------------------

def cutoff(work: Workload, sizes: Sizes) -> list[dict]:
    """Cut-off from 2 to 8 standard deviations."""
    rows = compare(work, [by_integrator(f'{e:g}', work, extent=e) for e in (2., 3., 3.5, 4., 5., 6., 7., 8.)], sizes)
    for row in rows:
        row['pairs'] = work.pairs(float(row['name']))
    return rows


def footprint(work: Workload, sizes: Sizes) -> list[dict]:
    """The affine model against the exact one, cone and parallel."""
    parallel = Workload(sizes.gaussians, sizes.pixels, sizes.box, mode='parallel')
    rows = []
    for beam, of in (('cone', work), ('parallel', parallel)):
        rows += compare(of, [by_integrator(f'{model}, {beam} beam', of, extent=6., footprint=model)
                             for model in ('exact', 'affine')], sizes)
    return rows


def methods(work: Workload, sizes: Sizes) -> list[dict]:
    """The splat, the closed form on every ray in three precisions, grids walked exactly and marched."""
    found = [by_integrator(f'splat, {e:g} σ', work, extent=e) for e in (2., 3., 4., EXTENT, 7.)]
    found.append(by_integrator('splat, affine, 7 σ', work, extent=7., footprint='affine'))
    for p in ('float32', 'compensated', 'float64'):
        found.append(by_function(f'every ray, {p}', work, lambda *x, p=p: alternatives.per_ray(*x, work.view, p),
                                 p != 'compensated'))
    for n in sizes.grids:
        found.append(by_function(f'grid {n}³, exact walk', work, lambda *x, n=n: _through_grid(work, x, n)))
        found += [by_function(f'grid {n}³, steps of {step:g} voxel', work,
                              lambda *x, n=n, s=step: _through_grid(work, x, n, s)) for step in (1., .5)]
    return compare(work, found, sizes)


def _through_grid(work: Workload, gaussians, n: int, step: float | None = None):
    """The image of a cloud sampled on n^3 voxels: walked exactly, or marched with steps of `step` voxels."""
    side = 2 / n
    data = voxelize(*gaussians, Grid(vector64((-1, -1, -1)), vector64((side,) * 3), (n,) * 3), EXTENT)
    origin, direction = alternatives.rays(work.view, 2.)
    if step:
        return alternatives.march(data, n, 1., origin, direction, step * side)
    i, count = dr.arange(mi.UInt32, n ** 3), dr.opaque(mi.UInt32, n)
    z, rest = i % count, i // count
    data = dr.gather(mi.Float, data, (z * count + rest % count) * count + rest // count, mode=dr.ReduceMode.Permute)
    return grid.line_integrals(data, (n,) * 3, (-1, -1, -1), (1, 1, 1), origin, direction)


def marching(work: Workload, sizes: Sizes) -> list[dict]:
    """Mitsuba's tree over `ellipsoids`, and how many rays it gets wrong by more than 1e-3 of the image's maximum."""
    found = [by_integrator(f'splat, {EXTENT:g} σ', work, extent=EXTENT)] + [by_tree(work, EXTENT, e) for e in EPSILONS]
    rows = compare(work, found, sizes)
    image = work.truth[0].ravel()
    for m, row in zip(found, rows):
        row['wrong_rays'] = float((abs(np.array(m.image()) - image) > 1e-3 * image.max()).mean())
    return rows


def by_tree(work: Workload, extent: float, epsilon: float) -> Method:
    """Marching through Mitsuba's tree, the rays starting just before the volume, where float32 is at its best."""
    tree = alternatives.Tree(work.data, work.density, extent, epsilon)
    origin, direction = alternatives.rays(work.view, 2.)
    weights = mi.Float(work.weights.ravel())

    def image():
        return tree.image(origin, direction)

    def gradients():
        image()
        return _split(*tree.gradients(origin, direction, weights))
    return Method(f'tree, epsilon {epsilon:g}', image, gradients)


def pixel(sizes: Sizes) -> list[dict]:
    """Rays a pixel, against the mean over the pixel."""
    work = Workload(sizes.few // 2, sizes.pixels, sizes.box, order=4)
    return compare(work, [by_integrator(f'{n} × {n}' if isinstance(n, int) else n, work, extent=7., pixel=n)
                          for n in ('centre', 2, 4, 'area')], sizes)


def teams(work: Workload, sizes: Sizes) -> list[dict]:
    """Into how many shares the work is cut, in parts of the usual number."""
    return compare(work, [by_integrator(f'{factor:g}', work, lambda f=factor: _teams(f), extent=EXTENT)
                          for factor in (.25, .5, 1, 2, 4, 16)], sizes)


@contextmanager
def _teams(factor: float):
    """The splat's work cut into `factor` times as many shares as usual."""
    class Work(balance.Work):
        def __init__(self, *args):
            super().__init__(*args)
            self.teams = max(round(factor * self.teams), 1)
    with mock.patch.object(splat, 'Work', Work):
        yield


# ------------------------------------------------------------------------------------------------------------
#  Scaling
# ------------------------------------------------------------------------------------------------------------

def scaling(sizes: Sizes) -> dict:
    """Time a pair and memory of forward and backward at 3 standard deviations, in three sweeps:

    pairs       more and more Gaussians of the same size
    gaussians   more and more, but smaller, ones: the same pairs
    pixels      the same cloud on finer and finer panels
    """
    total = sizes.gaussians * sizes.box
    clouds = dict(
        pairs=[(p, max(round(p / sizes.box), 1), sizes.pixels, sizes.box) for p in sizes.pairs],
        gaussians=[(n, n, 512, min(2 * total / n, 6e4)) for n in sizes.counts],
        pixels=[(side, sizes.gaussians, side, sizes.box * (side / sizes.pixels) ** 2) for side in sizes.panels])
    out = {}
    for name, points in clouds.items():
        out[name] = []
        for x, n, side, box in points:
            work = Workload(n, side, box)
            method = by_integrator(name, work, extent=3.)
            memory = [peak_memory(f)[1] for f in (method.image, method.gradients)]  # and compile
            take_turns([method], replace(sizes, rounds=min(sizes.rounds, 5)))
            pairs = work.pairs(3.)
            row = statistics(method.times)
            row |= dict(x=float(x), gaussians=n, side=side, pairs=pairs, memory_mb=memory[0],
                        memory_gradients_mb=memory[1])
            for key in ('forward', 'gradients'):
                row[f'{key}_ns_per_pair'] = 1e6 * row[f'{key}_ms'] / pairs
            out[name].append(row)
    return out


# ------------------------------------------------------------------------------------------------------------
#  Fits
# ------------------------------------------------------------------------------------------------------------

def dataset(side: int, views: int) -> Dataset:
    """The foot phantom on side^3 voxels, before panels of side^2 pixels."""
    phantom = phantoms.make('foot', side)
    angles = np.concatenate([circular(views, 180.), np.sort(np.random.default_rng(0).uniform(0, np.pi, views))])
    geometry = Geometry(1000., 1500., side, 512 / side, phantom.data.shape, phantom.spacing, angles)
    both = Scan(geometry, simulate(phantom, geometry))
    return Dataset(both.subset(slice(0, views)), both.subset(slice(views, None)), phantom.data)


def initialisations(sizes: Sizes) -> list[dict]:
    """Quality of initial clouds, before any iteration."""
    data = dataset(sizes.phantoms[0], sizes.views)
    rows = []
    kinds = {'lingo': dict(init='lingo'), 'lingo, paper density': dict(init='lingo', init_density='paper'),
             'r2': dict(init='r2')}
    initial_cloud(data.train, METHODS['fast'].changed(n_points=sizes.points[0]))  # compiles
    for name, changes in kinds.items():
        for n in sizes.points:
            settings = METHODS['fast'].changed(n_points=n, **changes)
            cloud = initial_cloud(data.train, settings)
            stepper = Stepper(data.train, settings)
            state = DeviceState(start(cloud.points, cloud.spacing, cloud.density / stepper.unit, settings))
            rows.append(dict(name=name, points=len(cloud), seconds=cloud.info['seconds'],
                             **quick_measure(data)(stepper, state)))
    return rows


def fits(sizes: Sizes) -> list[dict]:
    """Quality against seconds: recipes, iterations, cut-off, Gaussians to start with, size of the phantom."""
    small, most, points = sizes.phantoms[0], sizes.iterations[-1], sizes.points[1]
    plans = [(name, small, n, points, 3.) for name in VOLUMETRIC for n in sizes.iterations]
    plans += [('fast', small, sizes.iterations[-2], points, e) for e in (2., 4., EXTENT)]
    plans += [('fast', small, sizes.iterations[-2], p, 3.) for p in sizes.points if p != points]
    plans += [('fast', side, most, points, 3.) for side in sizes.phantoms[1:]]
    scans, rows = {}, []
    for name, side, iterations, points, extent in plans:
        data = scans.setdefault(side, dataset(side, sizes.views))
        settings = METHODS[name].changed(iterations=iterations, n_points=points, extent=extent)
        fitted = run(data.train, settings, initial_cloud(data.train, settings), measure=quick_measure(data))
        rows.append(dict(name=name, side=side, iterations=iterations, points=points, extent=extent,
                         gaussians=len(fitted.state), seconds=fitted.info['seconds'] + fitted.seconds,
                         seconds_init=fitted.info['seconds'], history=fitted.history,
                         **{k: v for k, v in fitted.history[-1].items() if k.startswith('psnr')}))
    return rows
