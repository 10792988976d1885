"""Phantoms: the same by seed and size, in range, exact where they say so; and the script that writes them."""

import functools
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lingo_mi as lm
from helpers.phantoms import forget
from helpers.short import short
from lingo_mi import phantoms
from lingo_mi.common.errors import InputError
from lingo_mi.files.ply import read_ply
from lingo_mi.files.volumes import read_volume
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.phantoms import DENSEST, chest, foot, gaussians, mesh, shepp_logan
from lingo_mi.phantoms import x3d_scan as scanning

SIZES = 64, 128
SCRIPT = Path(__file__).parents[2] / 'scripts' / 'phantom.py'


@pytest.fixture(scope='module')
def made():
    """A function of name and size, which makes each phantom once."""
    return functools.cache(phantoms.make)


def _halved(data):
    n = data.shape[0] // 2
    return data.reshape(n, 2, n, 2, n, 2).mean((1, 3, 5))


def _geometry(mode='cone', angles=(0.0, 0.7, 2.3), pixels=16, pixel=21.0, size=64):
    return CircularGeometry(
        DSO=1000.0,
        DSD=1500.0,
        nDetector=(pixels, pixels + 4),
        dDetector=(pixel, pixel),
        angles=np.array(angles),
        mode=mode,
        grid=Grid((size,) * 3, (256 / size,) * 3),
    )


def _line_sums(phantom, geometry, step=1.0):
    """Sums of nearest voxels along the rays: a crude but independent projector."""
    frames, (nv, nu) = geometry.rays(), geometry.nDetector
    x, y = np.meshgrid(np.arange(nu) + 0.5, np.arange(nv) + 0.5)
    out = np.zeros((len(geometry), nv, nu))
    size, h = phantom.data.shape[0], phantom.spacing[0]
    for view in range(len(geometry)):
        o, d = frames.through(view, x, y)
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        start = -(o * d).sum(-1)  # nearest to the axis' origin
        for t in np.arange(-170, 170, step) + step / 2:
            i = np.floor((o + (start + t)[..., None] * d) / h + size / 2).astype(int)
            ok = ((i >= 0) & (i < size)).all(-1)
            i = np.clip(i, 0, size - 1)
            out[view] += step * np.where(ok, phantom.data[i[..., 0], i[..., 1], i[..., 2]], 0)
    return out


# ---- all phantoms ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'name, size',
    [
        pytest.param(name, size, marks=pytest.mark.thorough if (name, size) == ('chest', 128) else ())
        for name in phantoms.names()
        for size in SIZES
    ],
)
def test_form(made, name, size):
    p = made(name, size)
    assert p.name == name and p.data.dtype == np.float32 and p.data.shape == (size,) * 3
    assert np.isfinite(p.data).all() and p.data.min() == 0 and 0.3 < p.data.max() <= 1
    assert (p.data == 0).mean() > 0.2
    assert np.allclose(p.grid.first_voxel, -np.multiply(p.spacing, size - 1) / 2)
    side = {'chest': 380}.get(name, 256)
    assert p.spacing == (side / size,) * 3


@pytest.mark.parametrize('name', short({name: name for name in phantoms.names()}, ('foot', 'gaussians', 'shepp_logan')))
def test_seed(name):
    data = phantoms.make(name, 16).data
    forget()
    assert np.array_equal(phantoms.make(name, 16).data, data)
    assert np.array_equal(phantoms.make(name, 16, seed=7).data, data) == (name in ('mesh', 'shepp_logan'))


@pytest.mark.parametrize(
    'name', short({name: name for name in phantoms.names()}, ('foot', 'gaussians', 'mesh', 'shepp_logan'))
)  # the chest takes many seconds to make
def test_sizes_agree(made, name):
    fine, coarse = _halved(made(name, 128).data), made(name, 64).data
    assert abs(fine.mean() / coarse.mean() - 1) < 0.02
    # gaussians: centre values, not averages
    assert np.sqrt(((fine - coarse) ** 2).mean()) < 0.08 * coarse.std()


@pytest.mark.parametrize('name', phantoms.names())
def test_no_flip_leaves_it_unchanged(made, name):
    data = made(name, 64).data
    for axes in (0, 1, 2, (0, 1), (0, 2), (1, 2), (0, 1, 2)):
        assert np.abs(np.flip(data, axes) - data).max() > 0.1
    for order in ((1, 0, 2), (0, 2, 1), (2, 1, 0)):
        assert np.abs(data.transpose(order) - data).max() > 0.1


@pytest.mark.parametrize(
    'name, size, seed, message',
    [
        ('hand', 32, 0, 'choose one of'),
        ('foot', 4, 0, '8 to 512'),
        ('foot', 5000, 0, '8 to 512'),
        ('foot', 32.5, 0, 'whole numbers'),
        ('foot', 32, -1, 'negative'),
    ],
)
def test_bad_input(name, size, seed, message):
    with pytest.raises(InputError, match=message):
        phantoms.make(name, size, seed)


def test_modules_import_no_mitsuba():
    for path in Path(phantoms.__file__).parent.glob('*.py'):
        import_line = re.search(r'^(import|from) +(mitsuba|drjit|\.\.xray)', path.read_text(), re.MULTILINE)
        assert not import_line, path


# ---- foot and chest ----------------------------------------------------------------------------------------


def test_foot_anatomy(made):
    data = made('foot', 128).data
    assert len(foot.bones()) == 30  # 26 bones, 2 sesamoids, tibia and fibula
    y, z = (np.flatnonzero(data.any(axis)) for axis in ((0, 2), (0, 1)))
    # heel and toes inside, spanning nearly all of it
    assert y[0] >= 1 and y[-1] <= 126 and np.ptp(y) > 110
    assert z[-1] == 127 and z[0] > 5  # the leg leaves through the top
    toes = data[:, 106:110].max((1, 2)) > 0  # a cut across the toes: air between them
    assert np.count_nonzero(np.diff(toes.astype(int)) == 1) >= 3
    assert data.max() > 0.9  # dense cortex


def test_chest_densities(made):
    assert np.allclose(chest.density(np.array([-2000, -1000, 0, 2000, 3000])), [0, 0, 1 / 3, 1, 1])
    data = made('chest', 64).data
    lung = data[8:20, 28:40, 26:34]
    assert 0.06 < np.quantile(lung[lung < 0.15], 0.5) < 0.1
    assert 0.42 < data.max() < 0.75


# ---- exact projections -------------------------------------------------------------------------------------


@pytest.mark.parametrize('mode', ['cone', pytest.param('parallel', marks=pytest.mark.thorough)])
@pytest.mark.parametrize('name', ['shepp_logan', 'gaussians', 'mesh'])
def test_projections_against_line_sums(made, name, mode):
    phantom = made(name, 128)
    geometry = _geometry(mode)
    exact, numeric = phantom.analytic.project(geometry), _line_sums(phantom, geometry)
    assert exact.dtype == np.float32 and exact.shape == (3, 16, 20) and (exact > -1e-4).all()
    assert np.sqrt(((exact - numeric) ** 2).mean() / (numeric**2).mean()) < 0.06
    assert np.isclose(exact.sum(), numeric.sum(), rtol=0.02)


def test_ellipsoid_chord():
    ball = shepp_logan.UniformEllipsoids(np.array([2.0]), np.zeros((1, 3)), np.eye(3)[None] / 50)
    image = ball.project(_geometry(pixels=1, pixel=1e-3, angles=(0.3,)))
    assert np.allclose(image[0, 0], 200)


def test_gaussian_mass_and_density():
    cloud = gaussians.cloud(50, seed=3)
    data = cloud.voxels(96)
    assert np.isclose(data.sum(dtype=float) * (256 / 96) ** 3, cloud.mass, rtol=2e-3)
    # Independent of the voxelizer: the sum at one voxel's centre.
    i = np.unravel_index(data.argmax(), data.shape)
    p = (np.array(i) + 0.5) * 256 / 96 - 128
    w = np.einsum('nij,nj->ni', cloud.whiten, p - cloud.centres)
    assert np.isclose(data[i], (cloud.density * np.exp(-0.5 * (w**2).sum(1))).sum(), rtol=1e-6)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_gaussian_projection_is_the_closed_form(mode):
    cloud, geometry = gaussians.cloud(20, seed=1), _geometry(mode, pixels=40, pixel=8.0)
    image, frames = cloud.project(geometry), geometry.rays()
    expected = np.zeros(image.shape)
    x, y = np.meshgrid(np.arange(44) + 0.5, np.arange(40) + 0.5)
    for view in range(3):
        o, ray = frames.through(view, x, y)
        for p, w_, rho in zip(cloud.centres, cloud.whiten, cloud.density):
            w, d = (o - p) @ w_.T, ray @ w_.T
            dd = (d * d).sum(-1)
            expected[view] += (
                rho * np.sqrt(2 * np.pi * (ray * ray).sum(-1) / dd) * np.exp(-0.5 * (np.cross(w, d) ** 2).sum(-1) / dd)
            )
    assert np.abs(image - expected).max() < 2e-7 * expected.max()


def test_gaussians_refuse_a_source_inside():
    geometry = CircularGeometry(DSO=40.0, DSD=300.0, nDetector=4, dDetector=1.0, angles=[0.0], grid=Grid(8, 32.0))
    with pytest.raises(InputError, match='enlarge DSO'):
        gaussians.cloud(100).project(geometry)
    with pytest.raises(InputError, match='at least one'):
        gaussians.cloud(0)


def test_flange_is_a_solid(tmp_path):
    part = mesh.flange()
    assert part.is_watertight and part.is_winding_consistent and part.volume > 0
    assert part.euler_number == 2 - 2 * (mesh.BOLTS + 1)  # a hole each, and the bore
    data = phantoms.make('mesh', 64).data
    assert np.isclose(data.sum(dtype=float) * 4**3, part.volume, rtol=1e-3)
    part.export(tmp_path / 'flange.ply')
    part.export(tmp_path / 'flange.obj')


def test_scan_of_a_phantom(made):
    phantom = made('shepp_logan', 64)
    g = scanning.default_geometry(phantom, [0.0])
    assert (g.DSD, g.DSO, g.nDetector, g.dDetector, g.grid.size) == (1500, 1000, (512, 512), (1, 1), (256, 256, 256))
    calls = []
    dataset = scanning.scan(phantom, 2, progress=lambda *a: calls.append(a))
    assert calls[-1] == (4, 4) and dataset.volume is phantom.data
    assert np.allclose(np.degrees(dataset.train.geometry.angles), [0, 90])
    assert (dataset.test.geometry.angles < np.pi).all()
    with pytest.raises(InputError, match='at least one view'):
        scanning.scan(phantom, 0)


# ---- the script --------------------------------------------------------------------------------------------


def _run(*args):
    return subprocess.run([sys.executable, SCRIPT, *map(str, args)], capture_output=True, text=True)


def test_script_writes(tmp_path, monkeypatch, capsys):
    out, scan = tmp_path / 'foot.nii.gz', tmp_path / 'foot.pickle'
    done = _run('foot', '--size', 32, '--out', out, '--projections', scan, '--views', 1)
    assert done.returncode == 0, done.stderr
    from lingo_mi.files.scans import read_scan
    from lingo_mi.files.volumes import read_volume

    volume = read_volume(out)
    assert np.array_equal(volume.data, phantoms.make('foot', 32).data) and np.allclose(volume.spacing, 8)
    dataset = read_scan(scan)
    assert len(dataset.train) == len(dataset.test) == 1
    assert dataset.train.projections.max() > 20
    assert _run_here(monkeypatch, 'foot', '--size', '32', '--out', str(out)) == 2
    assert '--force' in capsys.readouterr().err
    assert _run_here(monkeypatch, 'shepp_logan', '--size', '32', '--out', str(out), '--force') == 0
    assert np.array_equal(read_volume(out).data, phantoms.make('shepp_logan', 32).data)


def _run_here(monkeypatch, *args):
    monkeypatch.setattr(sys, 'argv', [str(SCRIPT), *args])
    try:
        runpy.run_path(str(SCRIPT), run_name='__main__')
    except SystemExit as stop:
        return stop.code
    return 0


def test_script_lists(monkeypatch, capsys):
    assert _run_here(monkeypatch, '--list') == 0
    assert tuple(line.split()[0] for line in capsys.readouterr().out.splitlines()) == phantoms.names()
    assert _run_here(monkeypatch, '--help') == 0
    assert 'examples:' in capsys.readouterr().out


@pytest.mark.parametrize(
    'args',
    [
        (),
        ('foot',),
        ('hand', '--out', 'x.nii.gz'),
        ('foot', '--out', 'x.png'),
        ('foot', '--size', 'big', '--out', 'x.nii.gz'),
        ('foot', '--size', '3', '--out', 'x.nii.gz'),
        ('foot', '--views', '0', '--projections', 'x'),
        ('foot', '--projections', 'x.npy'),
        ('foot', '--out', '/no/such/folder/x.nii.gz'),
        ('foot', '--kind', 'zip', '--projections', 'x'),
        ('foot', '--views', '999999999', '--projections', 'x.pickle'),
        ('foot', '--views', '9' * 400, '--projections', 'x.pickle'),
        ('foot', '--views', '99999', '--projections', 'x.pickle'),
        ('foot', '--seed', '-1', '--projections', 'x.pickle'),
        ('foot', '--seed', '9' * 400, '--projections', 'x.pickle'),
        ('foot', '--size', '9' * 400, '--out', 'x.nii.gz'),
    ],
)
def test_script_refuses(args, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr('lingo_mi.cli.phantom.room', lambda: 16 * 2**30)
    monkeypatch.chdir(tmp_path)
    assert _run_here(monkeypatch, *args) == 2
    message = capsys.readouterr().err
    assert message.startswith('error: ') and message.count('\n') == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('name', ['shepp_logan', 'foot'])
def test_real_attenuation_is_that_of_bone(name):
    """It is 2000 HU at most, in the volume and in line integrals, of ellipsoids and of voxels."""
    plain, real = lm.phantom(name, size=16), lm.phantom(name, size=16, attenuation='real')
    bone = 3 * 0.0206
    np.testing.assert_allclose(real.data, bone * plain.data, rtol=1e-6)
    assert real.data.max() <= bone
    scans = [lm.simulate(phantom, views=1, progress=False).train.projections for phantom in (plain, real)]
    np.testing.assert_allclose(scans[1], bone * scans[0], rtol=1e-5)
    with pytest.raises(InputError, match="attenuation must be 'x3d' or 'real'"):
        lm.phantom(name, size=16, attenuation='hu')


def test_script_writes_real_attenuation(tmp_path, monkeypatch):
    """It writes a volume and Gaussians, by the name that Python and scenes use."""
    for out in ('foot.nii.gz', 'gaussians.ply'):
        name = out.split('.')[0]
        for kind in ('x3d', 'real'):
            target = tmp_path / f'{kind}_{out}'
            arguments = [name, '--size', '16', '--attenuation', kind, '--out', str(target)]
            assert _run_here(monkeypatch, *arguments) == 0
    volumes = [read_volume(tmp_path / f'{kind}_foot.nii.gz') for kind in ('x3d', 'real')]
    np.testing.assert_allclose(volumes[1].data, DENSEST * volumes[0].data, rtol=1e-6)
    assert [v.unit for v in volumes] == ['normalised', '1/mm']
    clouds = [read_ply(tmp_path / f'{kind}_gaussians.ply')[3] for kind in ('x3d', 'real')]
    np.testing.assert_allclose(clouds[1], DENSEST * clouds[0], rtol=1e-6)


def test_scenes_of_real_attenuation():
    small = dict(size=16, pixels=16, pixel_size=32, voxels=16, voxel_size=16, views=2, test_views=1)
    x3d, real = (
        lm.simulate('x3d_foot', parameters=small | more, progress=False) for more in ({}, dict(attenuation='real'))
    )
    np.testing.assert_allclose(real.train.projections, DENSEST * x3d.train.projections, rtol=1e-5)
    with pytest.raises(Exception, match="attenuation must be 'x3d' or 'real', not 'unreal'"):
        lm.simulate('x3d_foot', parameters=small | dict(attenuation='unreal'), progress=False)
