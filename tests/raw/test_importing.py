"""Raw frames to line integrals: the truth comes back, and what is wrong is said in one line."""

import sys
import warnings

import numpy as np
import pytest
import yaml

import lingo_mi as lm
from helpers.raw_frames import check, load, raw_frames, save
from lingo_mi.cli import main
from lingo_mi.common.errors import InputError
from lingo_mi.files import scans
from lingo_mi.files.scans import write_scan
from lingo_mi.geometry import rtk
from lingo_mi.raw import importing
from lingo_mi.raw.importing import import_raw, import_to_zarr
from lingo_mi.raw.line_integrals import photons_of_images
from lingo_mi.raw.options import Options


def test_truth_comes_back(tmp_path, raw, scan_yml):
    check(load(save(tmp_path, raw) and tmp_path / 'views.npy', scan_yml, **save(tmp_path, raw)), raw)


def test_photons(tmp_path, scan_yml):
    """Twenty flats tell the photons to 5 %, the images to 15 %."""
    raw = raw_frames(shape=(96, 160))
    scan, imported = import_raw(
        save(tmp_path, raw) and tmp_path / 'views.npy', scan_yml, Options(**save(tmp_path, raw)), False
    )
    assert imported.history['photons_from_flats'] == pytest.approx(raw.photons, rel=0.05)
    assert photons_of_images(scan.projections, scan.valid) == pytest.approx(raw.photons, rel=0.15)


@pytest.mark.parametrize('what', ['bad pixels', 'rings', 'all pixels are valid', 'a view is black'])
def test_into_a_zarr(tmp_path, scan_yml, monkeypatch, what):
    """A few views are written at a time. Line integrals, mask, history and geometry are the same as in memory."""
    zarr = pytest.importorskip('zarr')
    n = 30 if what == 'rings' else 6
    raw = raw_frames(n=n, shape=(12, 300) if what == 'rings' else (24, 40))
    values = yaml.safe_load(scan_yml.read_text())
    scan_yml.write_text(yaml.safe_dump(values | dict(angles=np.linspace(0, 300, n).tolist())))
    if what == 'a view is black':
        raw.views[4] = raw.darks[0]
    save(tmp_path, raw)
    options = dict(flats=tmp_path / 'flats.npy', darks=tmp_path / 'darks.npy', rings=what == 'rings')
    if what == 'all pixels are valid':
        options = dict(i0=20000.0, saturation=1e9)
    options = Options(**options)
    monkeypatch.setattr('lingo_mi.raw.rings.MOST_PIXELS', 5 * n * 300)  # five rows at a time
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        wanted, imported = import_raw(tmp_path / 'views.npy', scan_yml, options, False)
        written, write, size = [], zarr.Array.__setitem__, wanted.projections[0].size

        def counted(array, index, values):
            written.append(np.size(values) // size)
            write(array, index, values)

        monkeypatch.setattr(zarr.Array, '__setitem__', counted)
        result = import_to_zarr(tmp_path / 'views.npy', scan_yml, options, tmp_path / 'b.zarr', False)
    monkeypatch.undo()
    assert result.history == imported.history and result.left_out == imported.left_out
    assert max(written) == 4
    scan = scans.read_scan(tmp_path / 'b.zarr').train
    np.testing.assert_array_equal(scan.projections, wanted.projections)
    np.testing.assert_array_equal(scan.valid, wanted.valid)
    assert (scan.stored is None) == (what != 'all pixels are valid') == (tmp_path / 'b.valid.npy').exists()
    assert scans.history_of(tmp_path / 'b.zarr') == result.history
    np.testing.assert_allclose(scan.geometry.rays().source, wanted.geometry.rays().source)


def test_an_import_into_a_zarr_that_fails(tmp_path, raw, scan_yml, capsys, monkeypatch):
    """It leaves nothing, and an earlier scan stays."""
    pytest.importorskip('zarr')
    out = tmp_path / 'out' / 'a.zarr'
    files = [str(tmp_path / f'{name}.npy') for name in ('views', 'flats', 'darks')]
    save(tmp_path, raw)
    arguments = ['lingo-mi', 'import', files[0], '--flats', files[1], '--darks', files[2], '--geometry', str(scan_yml)]

    def run(*more):
        monkeypatch.setattr(sys, 'argv', [*arguments, '--out', str(out), *more])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code

    with monkeypatch.context() as patch:
        patch.setattr(importing, 'photons_of_images', lambda *_: (_ for _ in ()).throw(InputError('it broke')))
        assert run() == 2 and capsys.readouterr().err.splitlines()[-1].endswith('it broke')
    assert not out.exists() and not list(out.parent.iterdir())
    assert run() == 0 and f'{out}: 6 views of 24 x 40 pixels' in capsys.readouterr().out
    assert {file.name for file in out.parent.iterdir()} == {'a.zarr', 'a.yml', 'a.valid.npy'}
    assert run('--force') == 2 and 'a.zarr: exists already; remove it or give another name' in capsys.readouterr().err


def test_without_noise_exact(tmp_path, scan_yml):
    """Only rounding to counts is left: half a count of 20 000 exp(-2)."""
    raw = raw_frames(noise=False)
    scan = load(save(tmp_path, raw) and tmp_path / 'views.npy', scan_yml, **save(tmp_path, raw))
    assert np.abs(scan.projections - raw.truth)[scan.valid].max() < 1e-3


def test_exposure_of_every_view(tmp_path, scan_yml):
    exposure = np.linspace(0.5, 1.5, 6)
    raw = raw_frames(exposure=exposure, noise=False)
    scan = load(save(tmp_path, raw) and tmp_path / 'views.npy', scan_yml, exposure=exposure, **save(tmp_path, raw))
    assert np.abs(scan.projections - raw.truth)[scan.valid].max() < 2e-3
    by_air = load(tmp_path / 'views.npy', scan_yml, air=(0, 3, 0, 40), **save(tmp_path, raw))
    assert np.abs(by_air.projections - raw.truth)[by_air.valid].max() < 2e-3


def test_crop_binning_and_views_keep_the_rays(tmp_path, raw, scan_yml):
    files = save(tmp_path, raw)
    whole = load(tmp_path / 'views.npy', scan_yml, **files)
    part = load(tmp_path / 'views.npy', scan_yml, crop=(4, 20, 6, 36), binning=2, views=(1, None, 2), **files)
    assert part.projections.shape == (3, 8, 15)
    rays, inner = whole.geometry.rays(), part.geometry.rays()
    np.testing.assert_allclose(inner.corner, (rays.corner + 4 * rays.v + 6 * rays.u)[1::2], atol=1e-9)
    np.testing.assert_allclose(inner.u, 2 * rays.u[1::2], atol=1e-12)
    truth = -np.log(np.exp(-raw.truth)[1::2, 4:20, 6:36].reshape(3, 8, 2, 15, 2).mean((2, 4)))
    assert np.abs(part.projections - truth).max() < 0.15  # three bad pixels of four would be refused
    assert np.abs(part.projections - truth).mean() < 0.02


def test_without_flats_the_air_level_is_needed(tmp_path, raw, scan_yml):
    np.save(tmp_path / 'views.npy', raw.views)
    with pytest.raises(lm.InputError, match='no flat frames; give flats=FILE, or the air level'):
        load(tmp_path / 'views.npy', scan_yml)
    np.save(tmp_path / 'darks.npy', raw.darks)
    with pytest.warns(UserWarning, match='brighter than the air level'):
        scan = load(tmp_path / 'views.npy', scan_yml, darks=tmp_path / 'darks.npy', air=(0, 3, 0, 40))
    # What is left of the gain, 20 %, is in the line integrals.
    assert np.abs(scan.projections - raw.truth)[:, ~raw.bad].mean() < 0.12


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (dict(flats='small.npy'), 'the flats have .* pixels, but the views have'),
        (dict(darks='small.npy'), 'the darks have .* pixels, but the views have'),
        (dict(flats='darks.npy'), 'not brighter than the dark frames'),
        (dict(crop=(0, 99, 0, 40)), r'crop = .* does not lie in a frame of \(24, 40\)'),
        (dict(air=(0, 3, 0, 40), percentile=99.0), 'give one of them'),
        (dict(views=(9, None, 1)), 'no view is left of 6'),
        (dict(exposure=[1, 2]), 'one for each of 6 views'),
        (dict(angles=[1.0, 2.0]), 'there are 2 angles for 6 views'),
        (dict(angles=5.0), 'there are 1 angles for 6 views'),
        (dict(binning=41), 'binning 41 is more than the 40 pixels of a view'),
        (dict(angles='commas.txt'), 'commas.txt: its numbers seem to have decimal commas'),
        (dict(angles=[0.0, 1, np.nan, 3, 4, 5]), 'angle 2 is not a finite number'),
        (dict(flats='shut.npy'), 'flat 4 is .* times as bright as the others; take it out'),
        (dict(saturation=500.0), 'nearly all pixels of flat 0 reach the saturation, 500 counts'),
        (dict(bining=2), "no option 'bining', did you mean binning"),
    ],
)
def test_refused_in_one_line(tmp_path, raw, scan_yml, change, message):
    files = save(tmp_path, raw)
    np.save(tmp_path / 'small.npy', raw.flats[:, :5])
    np.save(tmp_path / 'shut.npy', np.concatenate([raw.flats[:4], raw.darks[:1] + 5, raw.flats[4:]]))
    (tmp_path / 'commas.txt').write_text('0,25\n60,25\n120,25\n180,25\n240,25\n300,25\n')
    change = {name: tmp_path / value if isinstance(value, str) else value for name, value in change.items()}
    with pytest.raises(lm.InputError, match=message) as caught:
        load(tmp_path / 'views.npy', scan_yml, **{**files, **change})
    assert '\n' not in str(caught.value) and len(str(caught.value)) < 300 + len(str(tmp_path))


def test_black_view_and_counts_above_the_flat_are_warned_of(tmp_path, scan_yml):
    raw = raw_frames()
    raw.views[2] = 0
    files = save(tmp_path, raw)
    with pytest.warns(UserWarning, match='view 2 is without counts'):
        scan = load(tmp_path / 'views.npy', scan_yml, **files)
    assert not scan.valid[2].any() and scan.valid[3].any()
    raw = raw_frames(exposure=1.5)
    files = save(tmp_path, raw)
    with pytest.warns(UserWarning, match='6 views .* more than 10 % brighter than the air level'):
        load(tmp_path / 'views.npy', scan_yml, **files)


def test_import_writes_a_scan_with_its_history(tmp_path, raw, scan_yml, monkeypatch, capsys):
    from lingo_mi.cli import main

    files = save(tmp_path, raw)
    out = tmp_path / 'out.npy'
    args = ['lingo-mi', 'import', tmp_path / 'views.npy', '--geometry', scan_yml, '--out', out]
    args += ['--flats', files['flats'], '--darks', files['darks'], '--views', '::2']

    def run():
        monkeypatch.setattr('sys.argv', [str(a) for a in args])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code

    assert run() == 0
    assert '3 views of 24 x 40 pixels' in capsys.readouterr().out
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        scan = lm.load(out).train
    np.testing.assert_array_equal(scan.valid[0], ~raw.bad)
    history = yaml.safe_load(out.with_suffix('.yml').read_text())['history']
    assert history['views'] == [0, 5, 2] and history['bad_pixels'] == 8 and history['flats'].endswith('flats.npy (20)')
    before = out.read_bytes()
    assert run() == 2 and 'exists already; give --force' in capsys.readouterr().err and out.read_bytes() == before


@pytest.mark.parametrize('which', ['darks', 'flats'])
def test_dead_pixels_that_are_nan(tmp_path, raw, scan_yml, which):
    """In floating-point darks or flats, such pixels are masked, and change nothing else."""
    paths = save(tmp_path, raw)
    frames = getattr(raw, which).astype(np.float32)
    plain = load(tmp_path / 'views.npy', scan_yml, **paths)
    frames[:, 3, 5] = np.nan
    np.save(tmp_path / f'{which}.npy', frames)
    scan = load(tmp_path / 'views.npy', scan_yml, **paths)
    assert not scan.valid[:, 3, 5].any()
    same = np.ones(scan.valid.shape[1:], bool)
    same[3, 5] = False
    np.testing.assert_array_equal(scan.valid[:, same], plain.valid[:, same])
    valid = plain.valid & same
    np.testing.assert_allclose(scan.projections[valid], plain.projections[valid], atol=1e-4)


@pytest.mark.parametrize('out', ['views.npy', 'flats.npy'])
def test_what_is_imported_is_not_overwritten(tmp_path, raw, scan_yml, monkeypatch, capsys, out):
    paths, before = save(tmp_path, raw), (tmp_path / out).read_bytes()
    command = ['import', tmp_path / 'views.npy', '--geometry', scan_yml, '--out', tmp_path / out, '--force']
    monkeypatch.setattr(sys, 'argv', ['lingo-mi', *map(str, command), '--flats', str(paths['flats'])])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2 and f'{out}: would be overwritten' in capsys.readouterr().err
    assert (tmp_path / out).read_bytes() == before


# ---- frames in another order than ours -----------------------------------------------------------------------


@pytest.mark.parametrize('named', ['itself', 'in a .yml'])
def test_rows_of_rtk_run_up(tmp_path, named):
    """RTK's geometry goes with frames whose rows run up: turned round, cut and binned, every pixel keeps its ray."""
    shape = (11, 17)
    geometry = lm.Geometry.cone(
        DSO=100, DSD=150, nDetector=shape, dDetector=1.5, nVoxel=8, dVoxel=1, angles=np.radians([0, 70, 200])
    )
    p = np.random.default_rng(0).uniform(0, 2, (3, *shape)).astype(np.float32)
    np.save(tmp_path / 'frames.npy', (1000 * np.exp(-p[:, ::-1])).astype(np.float32))
    source, options = tmp_path / 'geometry.xml', dict(i0=1000.0, pixel=1.5)
    rtk.write_rtk(source, geometry.rays(), shape)
    if named != 'itself':
        values, options = dict(dDetector=[1.5, 1.5], nVoxel=[8, 8, 8], dVoxel=1, poses='geometry.xml'), dict(i0=1000.0)
        source = tmp_path / 'scan.yml'
        source.write_text(yaml.safe_dump(values))
    scan = load(tmp_path / 'frames.npy', source, **options)
    np.testing.assert_allclose(scan.projections, p, atol=1e-5)
    np.testing.assert_allclose(scan.geometry.rays().corner, geometry.rays().corner, atol=1e-9)
    # Frame rows 1 to 8 are our rows 3 to 10; binning by 3 keeps the first six of them.
    part = load(tmp_path / 'frames.npy', source, **options, crop=(1, 8, 2, 12), binning=3)
    mean = np.exp(-p[:, 3:9, 2:11]).reshape(3, 2, 3, 3, 3).mean((2, 4))
    np.testing.assert_allclose(part.projections, -np.log(mean), atol=1e-5)
    rays = geometry.rays()
    np.testing.assert_allclose(part.geometry.rays().corner, rays.corner + 3 * rays.v + 2 * rays.u, atol=1e-9)
    np.testing.assert_allclose(part.geometry.rays().v, 3 * rays.v, atol=1e-9)


# ---- what a grid of its own, files and options must not get wrong ---------------------------------------------------


@pytest.mark.parametrize('crop', [(0, 24, 0, 40), (0, 9, 0, 40), (3, 24, 0, 14)])
def test_the_own_grid_lies_where_the_panel_sees(tmp_path, raw, crop):
    """The grid is as high as the kept rows, and around the axis as wide as the farthest column."""
    values = dict(DSO=100, DSD=150, dDetector=[1, 1], angles=list(range(0, 360, 60)))
    (tmp_path / 'scan.yml').write_text(yaml.safe_dump(values))
    files = save(tmp_path, raw)
    scan = load(tmp_path / 'views.npy', tmp_path / 'scan.yml', crop=crop, **files).geometry
    v0, v1, u0, u1 = crop
    assert scan.grid.spacing == pytest.approx([2 / 3] * 3) and scan.grid.shape[2] == v1 - v0
    assert scan.grid.centre == pytest.approx([0, 0, (12 - (v0 + v1) / 2) * 2 / 3])
    assert scan.grid.shape[0] == scan.grid.shape[1] == 2 * max(20 - u0, u1 - 20)


def test_pixels_that_saturate_in_the_flats_are_left_out(tmp_path, raw):
    flats = np.minimum(raw.flats, 65535).astype(np.uint16)
    flats[:, 5:8, 6:9] = 65535
    files = save(tmp_path, raw) | dict(flats=tmp_path / 'clipped.npy')
    np.save(tmp_path / 'clipped.npy', flats)
    np.save(tmp_path / 'views.npy', np.clip(raw.views, 0, 40000).astype(np.uint16))
    values = dict(DSO=100, DSD=150, dDetector=[1, 1], angles=list(range(0, 360, 60)))
    (tmp_path / 'scan.yml').write_text(yaml.safe_dump(values))
    scan = load(tmp_path / 'views.npy', tmp_path / 'scan.yml', **files)
    assert not scan.valid[:, 5:8, 6:9].any() and scan.valid.mean() > 0.9


@pytest.mark.parametrize('name, value', [('valid', 'mask.npy'), ('I0', 5e4), ('input', 'intensity')])
def test_a_geometry_of_finished_projections_is_refused(tmp_path, raw, scan_yml, name, value):
    scan_yml.write_text(scan_yml.read_text() + yaml.safe_dump({name: value}))
    files = save(tmp_path, raw)
    with pytest.raises(lm.InputError, match=f'{name} describes projections, not raw frames'):
        load(tmp_path / 'views.npy', scan_yml, **files)


@pytest.mark.parametrize(
    'option',
    [
        dict(views=5),
        dict(views=(0, None)),
        dict(binning='2'),
        dict(binning=1.5),
        dict(percentile='50'),
        dict(i0='5'),
        dict(saturation='x'),
        dict(angles=[0, 1, 'a', 3]),
    ],
    ids=str,
)
def test_options_of_another_kind(tmp_path, raw, scan_yml, option):
    files = save(tmp_path, raw)
    with pytest.raises(lm.InputError, match=next(iter(option))):
        load(tmp_path / 'views.npy', scan_yml, **files | option)


def test_poses_that_the_geometry_names_are_not_overwritten(tmp_path, raw, monkeypatch, capsys):
    n = 1200
    np.save(tmp_path / 'frames.npy', np.ones((n, 2, 8), np.float32))
    g = lm.Geometry.helix(
        DSO=100, DSD=150, nDetector=(2, 8), dDetector=1, nVoxel=4, dVoxel=1, angles=np.linspace(0, 40, n), pitch=5.0
    )
    lm.Scan(g, np.ones((n, 2, 8), np.float32))
    write_scan(tmp_path / 'scan.npy', lm.Scan(g, np.ones((n, 2, 8), np.float32)), 'npy')
    values = yaml.safe_load((tmp_path / 'scan.yml').read_text())
    (tmp_path / 'geo.yml').write_text(yaml.safe_dump({k: v for k, v in values.items() if k != 'input'}))
    (tmp_path / 'scan.npy').unlink(), (tmp_path / 'scan.yml').unlink()
    before = (tmp_path / 'scan.poses.npy').read_bytes()
    command = [
        'import',
        tmp_path / 'frames.npy',
        '--geometry',
        tmp_path / 'geo.yml',
        '--out',
        tmp_path / 'scan.npy',
        '--i0',
        1,
    ]
    for more, says in ([], 'scan.poses.npy: would be overwritten'), (['--force'], 'would be overwritten'):
        monkeypatch.setattr(sys, 'argv', ['lingo-mi', *map(str, command), *more])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and says in capsys.readouterr().err
    assert (tmp_path / 'scan.poses.npy').read_bytes() == before


@pytest.mark.parametrize('name', ['dVoxel', 'sVoxel'])
def test_the_size_of_voxels_needs_their_number(tmp_path, raw, scan_yml, name):
    values = yaml.safe_load(scan_yml.read_text())
    scan_yml.write_text(yaml.safe_dump({k: v for k, v in values.items() if 'Voxel' not in k} | {name: 0.1}))
    with pytest.raises(InputError, match=f'{name} needs nVoxel'):
        load(tmp_path / 'views.npy', scan_yml, **save(tmp_path, raw))


def test_a_square_panel_in_one_number(tmp_path, scan_yml):
    np.save(tmp_path / 'v.npy', np.full((6, 5, 5), 100.0, np.float32))
    scan_yml.write_text(scan_yml.read_text() + 'nDetector: 5\n')
    assert load(tmp_path / 'v.npy', scan_yml, i0=100.0).geometry.nDetector == (5, 5)


@pytest.mark.parametrize('value', ['[1, 2, 3]', '[[1], [1, 2]]', '[5, 4]', 'wide'])
def test_a_panel_of_another_size(tmp_path, scan_yml, value):
    np.save(tmp_path / 'v.npy', np.full((6, 5, 5), 100.0, np.float32))
    scan_yml.write_text(scan_yml.read_text() + f'nDetector: {value}\n')
    with pytest.raises(InputError, match='nDetector is .*, but the frames have'):
        load(tmp_path / 'v.npy', scan_yml, i0=100.0)


def test_a_closed_shutter(tmp_path, scan_yml):
    """Half of the noise of a dark frame is above the mean dark count, and looks like line integrals of 8."""
    raw = raw_frames()
    raw.views[2] = raw.darks[0]
    files = save(tmp_path, raw)
    with pytest.warns(UserWarning, match='view 2 is without counts, or with hardly any'):
        scan = load(tmp_path / 'views.npy', scan_yml, **files)
    assert not scan.valid[2].any() and scan.valid[[0, 1, 3, 4, 5]].mean() > 0.9


def test_a_converter_of_fewer_bits_that_saturates(tmp_path, raw, scan_yml):
    files = save(tmp_path, raw)
    np.save(tmp_path / 'views.npy', np.minimum(raw.views, 16383))
    with pytest.warns(UserWarning, match='6 views .* saturated: .* highest count of 16383; give saturation=16383'):
        load(tmp_path / 'views.npy', scan_yml, **files)
    flats = np.minimum(raw.flats, 16000)  # below
    np.save(tmp_path / 'flats.npy', flats)
    with pytest.warns(UserWarning, match='of the pixels are left out') as caught:
        scan = load(tmp_path / 'views.npy', scan_yml, **files, saturation=16383)
    assert len(caught) == 1 and 0.2 < scan.valid.mean() < 0.5


def test_views_and_flats_of_different_types(tmp_path, raw, scan_yml):
    """Counts of flats may be higher than the type of the views can hold."""
    files = save(tmp_path, raw)
    np.save(tmp_path / 'views.npy', np.minimum(raw.views // 2, 32766).astype(np.int16))
    np.save(tmp_path / 'flats.npy', np.minimum(raw.flats.astype(np.uint32) * 2, 65534).astype(np.uint16))
    del files['darks']
    assert (np.load(tmp_path / 'flats.npy') > 32767).mean() > 0.5
    scan = load(tmp_path / 'views.npy', scan_yml, **files)
    assert scan.valid is None or scan.valid.mean() > 0.9


def test_most_pixels_left_out(tmp_path, raw, scan_yml):
    files = save(tmp_path, raw)
    with pytest.warns(UserWarning, match=r'[5-9]\d\.\d\d% of the pixels are left out'):
        load(tmp_path / 'views.npy', scan_yml, **files, saturation=float(np.percentile(raw.flats[0], 30)))
