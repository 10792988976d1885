"""Line integrals of a neural field: error and time against the number of samples on a ray.

python -m lingo_mi.validation.accuracy.field    # prints the table alone, in a minute
"""

from __future__ import annotations

import time

import drjit as dr
import numpy as np

from lingo_mi.common.runtime import use_variant
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.field.field_model import FieldModel
from lingo_mi.fitting.field.network import Network
from lingo_mi.fitting.field.options import Field
from lingo_mi.fitting.state import State
from lingo_mi.geometry import CircularGeometry, Geometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors import grid
from lingo_mi.projectors.upload import uploaded
from lingo_mi.validation.accuracy.compare import deviation
from lingo_mi.validation.accuracy.sizes import FULL, Sizes
from lingo_mi.validation.accuracy.tables import FIELD as COLUMNS
from lingo_mi.validation.markdown import table

FINE = 16  # the truth has so many times the samples of the largest measurement
# A cube that is the volume, and levels of 16 to 128 cells along its side: as fine as voxels of a fit.
FIELD = Field(field_cube=1.0, field_levels=4, field_growth=2.0)
AMPLITUDE = 4.0  # of random features: the densities then spread over the whole of (0, 1)


def samples(sizes: Sizes) -> list[dict]:
    """Rows of `sizes.samples` samples on a ray, in the middle of their parts (as views are rendered) and at random (as in a
    step); and of the exact projector of the field on voxels. Times are seconds of CPU."""
    side = max(sizes.grids)
    geometry = CircularGeometry(
        DSO=1000.0,
        DSD=1500.0,
        nDetector=(sizes.field_pixels, sizes.field_pixels),
        dDetector=(512 / sizes.field_pixels, 512 / sizes.field_pixels),
        angles=circular(1, 360, start=20),
        grid=Grid(side, 256 / side),
    )
    state = _random_field()
    expected = _image(FIELD.changed(field_samples=FINE * max(sizes.samples)), geometry, state)
    rows = []
    for n in sizes.samples:
        options = FIELD.changed(field_samples=n)
        _image(options, geometry, state)  # compiles
        times = [_timed(lambda options=options: _image(options, geometry, state)) for _ in range(3)]
        image, seconds = times[0][0], float(np.median([t for _, t in times]))
        at_random = deviation(_image(options, geometry, state, np.random.default_rng(0)), expected)[0]
        rows.append(_row(f'{n}', image, expected, seconds, random=at_random))
    for n in sizes.grids:
        voxels = geometry.on(Grid(n, 256 / n))
        volume, sampling = _timed(lambda voxels=voxels: FieldModel(FIELD, geometry, 1.0).volume(state, voxels.grid))
        image = grid.project_volume(volume, voxels)
        _, seconds = _timed(lambda volume=volume, voxels=voxels: grid.project_volume(volume, voxels))
        rows.append(_row(f'voxels, {n}³', image[0].ravel(), expected, seconds, sampling=1e3 * sampling))
    return rows


def _random_field() -> DeviceState:
    rng, none = np.random.default_rng(0), np.zeros(0, np.float32)
    values = Network(FIELD).initial(rng)
    values['features'] = rng.uniform(-AMPLITUDE, AMPLITUDE, values['features'].shape).astype(np.float32)
    return DeviceState(State(values, {}, {}, none, none, np.zeros(0, bool)))


def _image(
    options: Field, geometry: Geometry, state: DeviceState, rng: np.random.Generator | None = None
) -> np.ndarray:
    """One view, ray by ray; with random samples if `rng` is given."""
    model = FieldModel(options, geometry, 1.0)
    if rng is None:
        return model.render(state, geometry)[0].ravel()
    (height, width), n = geometry.nDetector, options.field_samples
    row, out = uploaded(grid.view_table(geometry)[0]), np.empty((height, width), np.float32)
    for v in range(height):
        x, y = np.arange(width) + 0.5, np.full(width, v + 0.5)
        within = uploaded(rng.random(n * width, np.float32))
        out[v] = model.integrals(state.values, row, uploaded(x), uploaded(y), within).numpy()
    return out.ravel() / np.float32(geometry.grid.scale)


def _timed(work):
    dr.sync_thread()
    began = time.process_time()
    result = work()
    dr.sync_thread()
    return result, time.process_time() - began


def _row(name: str, image: np.ndarray, expected: np.ndarray, seconds: float, **more: float) -> dict:
    l2, largest = deviation(image, expected)
    return dict(name=name, image=l2, image_max=largest, us_per_ray=1e6 * seconds / len(expected)) | more


if __name__ == '__main__':
    use_variant(None)
    print(table(COLUMNS, samples(FULL)))
