"""Joseph's projector for panels that lean, against the transcription, its transpose, and the exact projector."""

import mitsuba as mi
import numpy as np
import pytest

from helpers.grids import scan
from helpers.matrices import assert_kernels_serve_any_views, assert_pair, device_images, matrix
from helpers.motions import climbing, posed, reversed_panel, rolled, shaken, tilted, turned
from helpers.short import short
from lingo_mi.common.errors import InputError
from lingo_mi.geometry.grid import Grid
from lingo_mi.projectors.grid import project_volume
from lingo_mi.projectors.joseph import Joseph
from lingo_mi.projectors.tilted_joseph import TiltedJoseph

SMALL, STEEP, ALONG_Z = (0.05, 0.02, 0.0), (0.6, 0.0, 0.0), (1.3, 0.2, 0.0)
GEOMETRIES = {
    **{
        f'{tilt} {mode}': posed(tilted(*tilt), mode)
        for tilt in (SMALL, STEEP, ALONG_Z)
        for mode in ('cone', 'parallel')
    },
    'rolled': posed(rolled),
    'rolled parallel': posed(rolled, 'parallel'),
    **{motion.__name__: posed(motion) for motion in (climbing, shaken, turned, reversed_panel)},
    'circle': scan(n=3),
    'one slice': scan(n=3, nVoxel=(9, 11, 1)),
    'one sheet': scan('parallel', n=3, nVoxel=(1, 8, 7)),
    'one row': scan(n=3, nDetector=(1, 21)),
    'wide pixels': scan(n=3, dDetector=(9.0, 8.0)),
    'narrow pixels': scan(n=3, dDetector=(1.0, 1.1)),
    'close': scan(n=3, DSO=45.0, DSD=60.0),
}
SHORT = (
    f'{STEEP} parallel',
    f'{ALONG_Z} cone',
    'rolled parallel',
    'shaken',
    'reversed_panel',
    'one slice',
    'one sheet',
    'one row',
    'wide pixels',
    'close',
)


@pytest.mark.parametrize('geometry', short(GEOMETRIES, SHORT))
def test_against_the_transcription(geometry):
    dense = matrix(geometry, axes=3)
    for masked in (False, True):
        assert_pair(TiltedJoseph, geometry, dense, masked)


@pytest.mark.parametrize('geometry', GEOMETRIES.values(), ids=GEOMETRIES)
def test_transpose(geometry):
    A, rng = TiltedJoseph(geometry), np.random.default_rng(1)
    x = rng.normal(size=geometry.grid.shape).astype(np.float32)
    y = rng.normal(size=(3, *geometry.nDetector)).astype(np.float32)
    ax = A.forward(mi.Float(x.ravel()), range(3))[0].numpy().astype(float)
    aty = A.adjoint(device_images(y), range(3)).numpy().astype(float)
    scale = np.linalg.norm(ax) * np.linalg.norm(y)
    assert abs(ax @ y.transpose(0, 2, 1).ravel() - aty @ x.ravel()) < 1e-5 * scale and scale > 0


def test_before_an_upright_panel_it_is_the_other():
    """This holds because no ray is steeper than its fan."""
    geometry = scan(n=3, nVoxel=(16, 16, 8), dVoxel=2.0)
    x = mi.Float(np.random.default_rng(0).random(16 * 16 * 8, dtype=np.float32))
    expected, actual = (kind(geometry).forward(x, range(3))[0].numpy() for kind in (Joseph, TiltedJoseph))
    np.testing.assert_allclose(actual, expected, atol=1e-5 * expected.max())


def test_slabs_add_up():
    """Each slab is projected between slices of zeros, as by `slab_sweeps`."""
    geometry = posed(tilted(*STEEP))
    volume = np.random.default_rng(0).random(geometry.grid.shape, dtype=np.float32)
    A = TiltedJoseph(geometry)
    whole, total = A.forward(mi.Float(volume.ravel()), range(3))[0].numpy(), 0
    for begin, end in ((0, 3), (3, 5), (5, 7)):
        low, high = max(begin - 1, 0), min(end + 1, 7)
        slab = volume[:, :, low:high].copy()
        slab[:, :, : begin - low], slab[:, :, end - low :] = 0, 0
        part = A.of_slab(geometry.on(geometry.grid.slab(low, high)))
        total = total + part.forward(mi.Float(slab.ravel()), range(3))[0].numpy()
    np.testing.assert_allclose(total, whole, atol=1e-5 * whole.max())


@pytest.mark.parametrize('tilt', [SMALL, STEEP, ALONG_Z])
def test_smooth_ball_against_the_exact_projector(tilt):
    geometry = posed(tilted(*tilt)).on(Grid((40, 44, 36), (2.0, 1.8, 2.2), posed(tilted(*tilt)).grid.centre))
    x = np.stack(
        np.meshgrid(
            *[(np.arange(n) + 0.5 - n / 2) * d for n, d in zip(geometry.grid.shape, geometry.grid.spacing)],
            indexing='ij',
        ),
        -1,
    )
    volume = np.float32(0.02 / (1 + np.exp((np.linalg.norm(x, axis=-1) - 25) / 2.0)))
    result = TiltedJoseph(geometry).forward(mi.Float(volume.ravel()), range(3))[0].numpy()
    exact = project_volume(volume, geometry)
    assert np.linalg.norm(result.reshape(3, 21, 17).transpose(0, 2, 1) - exact) < 0.004 * np.linalg.norm(exact)


def test_kernels_serve_any_views():
    assert_kernels_serve_any_views(TiltedJoseph(posed(tilted(*SMALL))))


def test_a_source_beside_the_volume_is_refused():
    with pytest.raises(InputError, match='beside or inside'):
        TiltedJoseph(scan(DSO=15.0, DSD=300.0))
