"""Numbers of any size make a scan all of whose numbers are finite, or one line."""

import itertools
import warnings

import numpy as np
import pytest

from helpers.circles import circle
from helpers.poses import to_matrices
from lingo_mi.common.errors import InputError
from lingo_mi.geometry import Geometry, Grid, PosedGeometry, limits
from lingo_mi.geometry.matrices import from_matrices
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import circular, helix

EXTREME = (
    *(sign * x for x in (1e308, 1e300, 1e154, 1e30, 1e12, 1e7, 1e-12, 1e-30, 1e-300, 5e-324, 0) for sign in (1, -1)),
    *(10**400, -(10**400), 10**5000, 10**19, 2**32, 2**63, float('nan'), float('inf'), -float('inf')),
    *('', 'x', '1' * 400, None, [], {}, [1, 'x'], 1j, [[1, 2], [3]], b'1', np.array(1e308), np.full((3, 3, 3), 1e308)),
)
CONE = dict(DSO=100, DSD=150, nDetector=(6, 8), dDetector=1, nVoxel=(5, 6, 7), dVoxel=1, angles=[0.0, 1.0])
MOTION = 'offDetector', 'rotDetector', 'COR', 'tilt', 'height', 'offOrigin'
BEAMS = {
    'cone': (Geometry.cone, CONE, (*CONE, *MOTION)),
    'parallel': (
        Geometry.parallel,
        {k: v for k, v in CONE.items() if k not in ('DSO', 'DSD')},
        ('nDetector', 'dDetector', 'nVoxel', 'dVoxel', 'angles', *MOTION),
    ),
    'helix': (Geometry.helix, CONE | dict(pitch=3), (*CONE, 'pitch', *MOTION)),
    'per_view': (Geometry.per_view, CONE, (*CONE, 'mode', *MOTION)),
    'circle': (circle, CONE, (*CONE, 'mode', 'offDetector', 'offOrigin')),
}


@pytest.mark.parametrize('sine, refused', [(1.5e-9, False), (0.7e-9, True)])
def test_steps_that_span_a_panel(sine, refused):
    """The sine of the angle between them is above 1e-9."""
    rays = Rays(*np.array([[[0.0, 0, 9]], [[0, 0, 0]], [[2.0, 0, 0]], [[3.0, 3 * sine, 0]]]), False)
    if refused:
        with pytest.raises(InputError, match='span no panel'):
            rays.checked()
    else:
        assert len(rays.checked()) == 1


def finite_or_refused(make):
    """Return the result of `make`, all of whose numbers are finite, or None if it refuses in one line."""
    with warnings.catch_warnings():
        warnings.simplefilter('error')  # of an overflow too
        warnings.filterwarnings('ignore', message='angles are radians')
        try:
            geometry = make()
        except InputError as error:
            assert str(error) and '\n' not in str(error) and len(str(error)) < 300
            return None
        rays, normalised = geometry.rays(), geometry.normalised_rays()
        for array in (rays.source, rays.corner, rays.u, rays.v, geometry.voxel_matrices(), geometry.angles):
            assert np.isfinite(array).all()
        for array in (normalised.source, normalised.corner, normalised.u, normalised.v):
            assert (np.abs(array) <= 1e13).all()  # whose products of three are finite in float32
        assert np.isfinite(
            [*geometry.grid.size, *geometry.sDetector, geometry.grid.scale, geometry.DSO, geometry.DSD]
        ).all()
        geometry.binned(2), geometry.subset([0]), geometry.joined(geometry), repr(geometry)
    return geometry


def variants(value, name):
    """An extreme value as it is, and as one of several."""
    yield value
    usual = np.asarray(CONE.get(name, 1)).ravel().tolist()
    for size in {max(len(usual), 2), 3}:
        for i in range(size):
            yield [value if k == i else usual[k % len(usual)] for k in range(size)]


def in_short_form(beam, name):
    """Return whether the short form tests a number: all by views, all of CONE, those that views lack, and one motion a beam."""
    motion = dict(cone='COR', parallel='rotDetector', helix='height', circle='offDetector')
    return (
        beam == 'per_view'
        or name == motion[beam]
        or name not in BEAMS['per_view'][2]
        or (beam == 'cone' and name in CONE)
    )


@pytest.mark.parametrize(
    'beam, name',
    [
        pytest.param(beam, name, marks=() if in_short_form(beam, name) else pytest.mark.thorough)
        for beam, (*_, names) in BEAMS.items()
        for name in names
    ],
)
def test_one_extreme_number(beam, name):
    make, numbers, _ = BEAMS[beam]
    for value in EXTREME:
        for extreme in variants(value, name):
            finite_or_refused(lambda: make(**{**numbers, name: extreme}))


@pytest.mark.parametrize('beam', [pytest.param(b, marks=pytest.mark.thorough if b == 'helix' else ()) for b in BEAMS])
def test_extreme_numbers_together(beam):
    """Each number is as large or small as it may be alone."""
    make, numbers, _ = BEAMS[beam]
    sizes = [name for name in ('DSO', 'DSD', 'dDetector', 'dVoxel', 'pitch') if name in numbers]
    for values in itertools.product((1e-12, 1e-6, 1.0, 1e6, 1e12), repeat=len(sizes)):
        finite_or_refused(lambda: make(**{**numbers, **dict(zip(sizes, values))}))


def test_usual_numbers_are_far_from_the_limits():
    """They are a synchrotron with a detector of 10 nm and a parallel beam as a cone of 1000 km, in metres and nanometres."""
    for changes in (
        dict(DSO=1.5e5, DSD=1.5e5 + 1, dDetector=1e-5, dVoxel=1e-5),
        dict(DSO=1e9, DSD=1e9 + 100),
        dict(DSO=0.1, DSD=0.15, dDetector=1e-7, dVoxel=1e-7),
        dict(DSO=1e9, DSD=1.5e9, dDetector=100, dVoxel=100),
    ):
        assert finite_or_refused(lambda: Geometry.cone(**{**CONE, **changes})) is not None


def test_poses():
    rays = Geometry.cone(**CONE).rays()
    panel = dict(nDetector=(6, 8), grid=Grid(8, 1))
    for name, value, parallel in itertools.product(('source', 'corner', 'u', 'v'), EXTREME, (False, True)):
        arrays = dict(source=rays.source, corner=rays.corner, u=rays.u, v=rays.v)
        try:
            arrays[name] = arrays[name].copy()
            arrays[name][1, 2] = value
        except (TypeError, ValueError, OverflowError):
            arrays[name] = value
        finite_or_refused(lambda: Geometry.from_poses(Rays(**arrays, parallel=parallel), **panel))
    arrays = (np.full((2, 3), 1e12 * s) for s in (1, 2, 3, 4))
    finite_or_refused(lambda: PosedGeometry(poses=Rays(*arrays, parallel=False), **panel))


def test_matrices():
    sound = to_matrices(Geometry.cone(**CONE).rays())

    def check(matrices):
        finite_or_refused(
            lambda: Geometry.from_poses(from_matrices(matrices, (6, 8), (1, 1), False), (6, 8), nVoxel=8, dVoxel=1)
        )

    for value in EXTREME:
        for row, column in itertools.product(range(3), range(4)):
            matrices = sound.astype(object)
            matrices[1, row, column] = value
            check(matrices)
        if isinstance(value, float) and 0 < abs(value) < 1e90:
            check(sound * value)


TIGRE = dict(
    DSO=100, DSD=150, nDetector=[6, 8], dDetector=[1, 1], nVoxel=[5, 6, 7], dVoxel=[1, 1, 1],
    offOrigin=[0, 0, 0], offDetector=[0, 0], rotDetector=[0, 0, 0], COR=0, mode='cone',
)  # fmt: skip
ASTRA = dict(
    type='cone', DistanceOriginSource=100, DistanceOriginDetector=50, DetectorRowCount=6, DetectorColCount=8,
    DetectorSpacingX=1, DetectorSpacingY=1, ProjectionAngles=[0.0, 1.0],
)  # fmt: skip
VOLUME = dict(
    GridColCount=5, GridRowCount=6, GridSliceCount=7,
    option=dict(WindowMinX=-1, WindowMaxX=1, WindowMinY=-1, WindowMaxY=1, WindowMinZ=-1, WindowMaxZ=1),
)  # fmt: skip


@pytest.mark.parametrize('name', TIGRE)
def test_tigre(name):
    for value in EXTREME:
        for extreme in variants(value, name):
            finite_or_refused(lambda: Geometry.from_tigre({**TIGRE, name: extreme}, [0.0, 1.0]))
            if name[0] == 'd':
                rest = {k: v for k, v in TIGRE.items() if k != name}
                finite_or_refused(lambda: Geometry.from_tigre({**rest, 's' + name[1:]: extreme}, [0.0, 1.0]))
    for value in EXTREME:
        finite_or_refused(lambda: Geometry.from_tigre(TIGRE, value))


@pytest.mark.parametrize('name', [*ASTRA, *VOLUME, *VOLUME['option']])
def test_astra(name):
    for value in EXTREME:
        proj = {**ASTRA, name: value} if name in ASTRA else ASTRA
        volume = {**VOLUME, name: value} if name in VOLUME else VOLUME
        if name in VOLUME['option']:
            volume = {**VOLUME, 'option': {**VOLUME['option'], name: value}}
        finite_or_refused(lambda: Geometry.from_astra(proj, volume))


def test_trajectories():
    for value in EXTREME:
        for make in (
            lambda: circular(value),
            lambda: circular(3, total=value),
            lambda: circular(3, start=value),
            lambda: helix([0.0, 1.0], value),
            lambda: helix([0.0, value], 3.0),
        ):
            with warnings.catch_warnings():
                warnings.simplefilter('error')
                try:
                    assert np.isfinite(make()).all()
                except InputError as error:
                    assert '\n' not in str(error) and len(str(error)) < 300
    with pytest.raises(InputError, match='at most 100000 views'):
        circular(999999999)


def test_counts():
    for name in ('nDetector', 'nVoxel'):
        Geometry.cone(**{**CONE, name: limits.MOST_COUNT, 'dDetector': 1e-3, 'dVoxel': 1e-3})
        with pytest.raises(InputError, match=f'{name} must be at most 1000000'):
            Geometry.cone(**{**CONE, name: limits.MOST_COUNT + 1})
