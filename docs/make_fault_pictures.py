"""Make docs/figures/faults/*.png: a small scan with one fault made on purpose, a sound slice beside it, and the slice mended.

    python docs/make_fault_pictures.py            # all, some minutes
    python docs/make_fault_pictures.py axis air   # some
    python docs/make_fault_pictures.py --check    # also prints what `lingo-mi inspect` and `calibrate` say of each scan

The object is the phantom foot with the attenuation of a real one, scanned on 128 voxels a side, reconstructed on 64.
"""

import argparse
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib
import numpy as np

import lingo_mi as lm
from lingo_mi.files.scans import write_scan

matplotlib.use('agg')
import matplotlib.pyplot as plt

FIGURES = Path(__file__).resolve().parent / 'figures' / 'faults'
BONE = 0.05  # 1/mm, the attenuation where the phantom has the density 1
SIDE = 192.0  # mm, of the volume
PANEL = dict(DSO=1000, DSD=1500, dDetector=3.6)  # mm
COLUMNS = 96


def geometry(angles=None, columns=COLUMNS, voxels=64, **changes) -> lm.Geometry:
    """The scanner of all scans here, with a full turn of 90 views, or with what a fault changes."""
    turn = lm.circular(90, 360) if angles is None else angles
    grid = dict(nVoxel=voxels, dVoxel=SIDE / voxels)
    return lm.Geometry.cone(**PANEL | dict(nDetector=(COLUMNS, columns), angles=turn) | grid | changes)


class Sound:
    """The object and its scans without a fault."""

    def __init__(self):
        self.object = BONE * lm.phantom('foot', size=128).data

    def scan(self, angles=None, **changes) -> lm.Scan:
        fine = geometry(angles, voxels=128, **changes)
        data = lm.simulate(self.object, fine, progress=False)
        return lm.Scan(geometry(angles, **changes), data.train.projections)


@dataclass(frozen=True)
class Fault:
    """A scan with a fault, and the same scan mended.

    make       from `Sound`, the faulty scan
    mend       from `Sound` and the faulty scan, the mended one
    algorithm  that reconstructs both; `mended_by` where another one is the remedy
    places     from a volume [x, y, z], the image that shows the fault
    calibrate  arguments for `lingo-mi calibrate`, where that finds it
    own_scale  whether each slice has its own largest value as white, as in a viewer
    """

    make: Callable
    mend: Callable
    algorithm: object = lm.FDK()
    mended_by: object = None
    places: Callable = lambda volume: volume[:, :, 16].T
    calibrate: tuple | None = None
    own_scale: bool = False


def with_column(sound):
    scan = sound.scan()
    p = scan.projections.copy()
    p[:, :, 37] = 0.5 * p[:, :, 37]
    return replace(scan, projections=p)


def without_column(sound, scan):
    valid = np.ones(scan.projections.shape, bool)
    valid[:, :, 37] = False
    return replace(scan, valid=valid)


def noisy(sound, photons=300):
    scan = sound.scan()
    counts = np.random.default_rng(0).poisson(photons * np.exp(-scan.projections))
    return replace(scan, projections=np.log(photons / np.maximum(counts, 1)).astype(np.float32))


def hardened(sound):
    scan = sound.scan()
    p = scan.projections
    return replace(scan, projections=(p / (1 + 0.25 * p)).astype(np.float32))


def out_of_order(sound):
    """Frames in the order of their names as text: 0, 1, 10, 100, ..."""
    scan = sound.scan(lm.circular(180, 360))
    return replace(scan, projections=scan.projections[sorted(range(len(scan)), key=str)])


def calibrated(sound, scan):
    return lm.calibrate(scan, curve=1, progress=False).corrected(scan)


def recalibrated(sound, scan):
    return lm.calibrate(scan, progress=False).corrected(scan)


def changed(change):
    """A fault of the projections alone."""
    return lambda sound: replace(sound.scan(), projections=change(sound.scan().projections))


def taken_as(wrong, **right):
    """A scan by the scanner `right`, reconstructed as if it were by `wrong`."""

    def make(sound):
        scan = sound.scan(**right)
        return lm.Scan(wrong(scan.geometry), scan.projections)

    return make


OFF = dict(offDetector=(0, 2 * PANEL['dDetector']))  # two pixels
HALF = dict(angles=lm.circular(60, 180))
FEW = dict(angles=lm.circular(12, 360))
SAGITTAL = dict(places=lambda volume: volume[30].T)

FAULTS = {
    'truncation': Fault(lambda s: s.scan(columns=44), lambda s, scan: scan, mended_by=lm.SART(niter=20)),
    'air': Fault(changed(lambda p: p + 0.8), lambda s, scan: replace(scan, projections=scan.projections - 0.8)),
    'column': Fault(with_column, without_column, mended_by=lm.SIRT(niter=60)),
    'axis': Fault(taken_as(lambda g: geometry(), **OFF), recalibrated, calibrate=()),
    'half_moon': Fault(
        taken_as(lambda g: geometry(HALF['angles']), **OFF, **HALF), recalibrated, lm.SART(niter=10), calibrate=()
    ),
    'reversed': Fault(taken_as(lambda g: geometry(-lm.circular(90, 360))), lambda s, scan: s.scan()),
    'order': Fault(out_of_order, lambda s, scan: s.scan()),
    'radians': Fault(
        taken_as(lambda g: geometry(np.radians(lm.circular(90, 360)))), lambda s, scan: s.scan(), lm.SART(niter=5)
    ),
    'few_views': Fault(lambda s: s.scan(**FEW), lambda s, scan: scan, mended_by=lm.Best()),
    'upside_down': Fault(changed(lambda p: p[:, ::-1]), lambda s, scan: s.scan(), **SAGITTAL),
    'mirrored': Fault(
        lambda s: lm.Scan(geometry(-lm.circular(90, 360)), s.scan().projections[:, :, ::-1]), lambda s, scan: s.scan()
    ),
    'all_zero': Fault(
        lambda s: replace(s.scan(), projections=-noisy(s, 20_000).projections),
        lambda s, scan: replace(scan, projections=-scan.projections),
        lm.SART(niter=10),
    ),
    'noise': Fault(noisy, lambda s, scan: scan, mended_by=lm.Best()),
    'hardening': Fault(hardened, calibrated, calibrate=('--curve', '1'), own_scale=True),
    'thousand': Fault(
        changed(lambda p: p / 1000), lambda s, scan: replace(scan, projections=1000 * scan.projections), own_scale=True
    ),
}


def volume(scan, algorithm):
    return lm.reconstruct(scan, algorithm, progress=False).volume


def draw(name: str, fault: Fault, sound: Sound, scan: lm.Scan):
    """Three slices: of the object, with the fault, and mended, in the greys of the object."""
    found = volume(scan, fault.algorithm)
    mended = volume(fault.mend(sound, scan), fault.mended_by or fault.algorithm)
    truth = sound.object.reshape(64, 2, 64, 2, 64, 2).mean((1, 3, 5))
    figure, panels = plt.subplots(1, 3, figsize=(6.6, 2.45))
    for axes, title, values in zip(panels, ('the object', 'with the fault', 'mended'), (truth, found, mended)):
        image, top = fault.places(values), fault.places(truth).max()
        if fault.own_scale:
            top = image.max()
            title += f', up to {top:.2g}/mm'
        axes.imshow(image, cmap='gray', vmin=0, vmax=top, origin='lower', interpolation='nearest')
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    figure.subplots_adjust(left=0.005, right=0.995, bottom=0.01, top=0.88, wspace=0.03)
    figure.savefig(FIGURES / f'{name}.png', dpi=85)
    plt.close(figure)


def check(name: str, fault: Fault, scan: lm.Scan):
    """What the commands say of the faulty scan."""
    with TemporaryDirectory() as folder:
        write_scan(Path(folder) / 'scan.npy', scan, 'npy')
        commands = [['inspect'], *([] if fault.calibrate is None else [['calibrate', *fault.calibrate]])]
        for command in commands:
            line = [sys.executable, '-m', 'lingo_mi', command[0], 'scan.npy', *command[1:]]
            done = subprocess.run(line, cwd=folder, capture_output=True, text=True)
            print(f'== {name}: {" ".join(command)} ({done.returncode})\n{done.stdout}{done.stderr[-600:]}', flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('names', nargs='*', choices=[*FAULTS, []], help='faults (default: all)')
    parser.add_argument('--check', action='store_true', help='run the commands on each scan, too')
    args = parser.parse_args()
    lm.use_variant('llvm_ad_mono')
    FIGURES.mkdir(exist_ok=True)
    sound = Sound()
    for name in args.names or FAULTS:
        scan = FAULTS[name].make(sound)
        draw(name, FAULTS[name], sound, scan)
        if args.check:
            check(name, FAULTS[name], scan)


if __name__ == '__main__':
    main()
