"""Raw frames to line integrals: the truth comes back, from every layout, and what is wrong is said in one line."""

import struct
import sys
import warnings

import numpy as np
import pytest
import yaml
from PIL import Image

import lingo_mi as lm
from helpers.raw_frames import raw_frames
from lingo_mi.cli import main
from lingo_mi.common.errors import InputError
from lingo_mi.files import scans
from lingo_mi.files.scans import write_scan
from lingo_mi.files.volumes import read_volume
from lingo_mi.geometry import rtk
from lingo_mi.raw import frames
from lingo_mi.raw.frames import open_recording
from lingo_mi.raw.importing import import_raw
from lingo_mi.raw.line_integrals import photons_of_images
from lingo_mi.raw.options import Options

tifffile = pytest.importorskip('tifffile')


@pytest.fixture(scope='module')
def raw():
    return raw_frames()


@pytest.fixture
def scan_yml(tmp_path):
    values = dict(DSO=100, DSD=150, dDetector=[1, 1], nVoxel=[16, 16, 16], dVoxel=1, angles=list(range(0, 360, 60)))
    path = tmp_path / 'scan.yml'
    path.write_text(yaml.safe_dump(values))
    return path


def load(frames, geometry, **options):
    return lm.load_raw(frames, geometry, progress=False, **options)


def save(tmp_path, raw):
    for name in ('views', 'flats', 'darks'):
        np.save(tmp_path / f'{name}.npy', getattr(raw, name))
    return dict(flats=tmp_path / 'flats.npy', darks=tmp_path / 'darks.npy')


def check(scan, raw):
    """Line integrals within five of their own standard deviations, the mask exactly the bad pixels."""
    valid = np.ones(scan.projections.shape, bool) if scan.valid is None else scan.valid
    np.testing.assert_array_equal(valid, np.broadcast_to(~raw.bad, valid.shape))
    sigma = np.sqrt(np.exp(raw.truth) / raw.photons * (1 + 1 / 20) * 1.3)
    assert (np.abs(scan.projections - raw.truth)[valid] < 5 * sigma[valid]).all()
    assert abs((scan.projections - raw.truth)[valid].mean()) < 1e-3


def write_tiff_folder(folder, stack):
    folder.mkdir()
    for i, image in enumerate(stack):
        tifffile.imwrite(folder / f'a_{i}.tif', image)  # a_10 sorts after a_9


def test_truth_comes_back(tmp_path, raw, scan_yml):
    check(load(save(tmp_path, raw) and tmp_path / 'views.npy', scan_yml, **save(tmp_path, raw)), raw)


def test_tiff_folders(tmp_path, scan_yml):
    raw = raw_frames(n=12)
    scan_yml.write_text(scan_yml.read_text().replace('angles: [0, 60, 120, 180, 240, 300]', ''))
    values = yaml.safe_load(scan_yml.read_text())
    values['angles'] = list(range(0, 360, 30))
    scan_yml.write_text(yaml.safe_dump(values))
    for name in ('views', 'flats', 'darks'):
        write_tiff_folder(tmp_path / name, getattr(raw, name))
    check(load(tmp_path / 'views', scan_yml, flats=tmp_path / 'flats', darks=tmp_path / 'darks'), raw)


def test_tiff_stack(tmp_path, raw, scan_yml):
    for name in ('views', 'flats', 'darks'):
        tifffile.imwrite(tmp_path / f'{name}.tif', getattr(raw, name), photometric='minisblack')
    check(load(tmp_path / 'views.tif', scan_yml, flats=tmp_path / 'flats.tif', darks=tmp_path / 'darks.tif'), raw)


def test_edf_of_several_frames(tmp_path, raw, scan_yml):
    image = pytest.importorskip('fabio').edfimage.EdfImage(data=raw.views[0])
    for view in raw.views[1:]:
        image.append_frame(data=view)
    image.write(str(tmp_path / 'views.edf'))
    check(load(tmp_path / 'views.edf', scan_yml, **save(tmp_path, raw)), raw)


def test_edf(tmp_path, raw, scan_yml):
    edf = pytest.importorskip('fabio').edfimage.EdfImage
    (tmp_path / 'views').mkdir()
    for i, image in enumerate(raw.views):
        edf(data=image).write(str(tmp_path / 'views' / f'{i}.edf'))
    check(load(tmp_path / 'views', scan_yml, **save(tmp_path, raw)), raw)


@pytest.mark.parametrize(('suffix', 'dtype'), [('png', np.uint8), ('png', np.uint16), ('jp2', np.uint16)], ids=str)
def test_pictures(tmp_path, suffix, dtype):
    stack = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (11, 12, 9)).astype(dtype)
    for i, image in enumerate(stack):
        Image.fromarray(image).save(tmp_path / f'a{i}.{suffix}')
    views = open_recording(tmp_path).views
    assert (len(views), views.shape, views.dtype) == (11, (12, 9), dtype)
    np.testing.assert_array_equal([views[i] for i in range(11)], stack)
    (tmp_path / f'a3.{suffix}').write_bytes((tmp_path / f'a3.{suffix}').read_bytes()[:-40])
    with pytest.raises(InputError, match='a3'):
        open_recording(tmp_path).views[3]
    (tmp_path / f'a0.{suffix}').write_bytes(b'none')
    with pytest.raises(InputError, match=f'a0.{suffix}: is damaged '):
        open_recording(tmp_path)


@pytest.mark.parametrize('mode', ['RGB', 'P', 'LA', '1'])
def test_pictures_in_colours(tmp_path, mode):
    Image.new(mode, (9, 12)).save(tmp_path / 'a.png')
    with pytest.raises(InputError, match=f'a.png: holds {mode} pixels .*; write counts as 8 or 16 bits of grey'):
        open_recording(tmp_path)


def write_his(path, image):
    """Elekta's format: a header of 68 bytes with corners, count and type, 32 further bytes, then the counts."""
    header, n = bytearray(100), len(image)
    header[:4] = 0, 0x70, 68, 0
    struct.pack_into('<H', header, 10, 32)
    struct.pack_into('<5H', header, 12, 1, 1, n, n, 1)
    header[32] = 4
    path.write_bytes(bytes(header) + image.astype('<u2').tobytes())


@pytest.mark.thorough
def test_frames_that_rtk_reads(tmp_path):
    pytest.importorskip('itk')
    frames = np.random.default_rng(0).integers(0, 60_000, (11, 8, 8))
    for i, image in enumerate(frames):
        write_his(tmp_path / f'{i}.his', image)
    views = open_recording(tmp_path).views
    assert (len(views), views.shape, views.dtype) == (11, (8, 8), np.uint16)
    np.testing.assert_array_equal([views[i] for i in range(11)], frames)
    (tmp_path / '3.his').write_bytes((tmp_path / '3.his').read_bytes()[:90])
    with pytest.raises(InputError, match='3.his|frame 3'):
        open_recording(tmp_path).views[3]


def test_one_frame_is_no_recording(tmp_path):
    write_his(tmp_path / '0.his', np.zeros((8, 8)))
    with pytest.raises(InputError, match='give the folder'):
        open_recording(tmp_path / '0.his')


def test_what_rtk_needs(tmp_path, monkeypatch):
    write_his(tmp_path / '0.his', np.zeros((8, 8)))
    monkeypatch.setitem(sys.modules, 'itk', None)
    with pytest.raises(InputError, match="'.\\[reference\\]'"):
        open_recording(tmp_path)


@pytest.mark.parametrize('layout', ['dxchange', 'nxtomo'])
@pytest.mark.parametrize('unit', ['degree', 'rad'])
def test_hdf5(tmp_path, raw, scan_yml, layout, unit):
    h5py = pytest.importorskip('h5py')
    values = yaml.safe_load(scan_yml.read_text())
    del values['angles']
    scan_yml.write_text(yaml.safe_dump(values))
    angles = np.arange(0, 360, 60.0) + 7
    stored = np.radians(angles) if unit == 'rad' else angles
    path = tmp_path / 'tomo.h5'
    with h5py.File(path, 'w') as file:
        if layout == 'dxchange':
            for name, stack in (('data', raw.views), ('data_white', raw.flats), ('data_dark', raw.darks)):
                file[f'exchange/{name}'] = stack
            theta = file.create_dataset('exchange/theta', data=stored)
        else:
            file['entry/instrument/detector/data'] = np.concatenate([raw.darks, raw.flats, raw.views])
            file['entry/instrument/detector/image_key'] = (
                [2] * len(raw.darks) + [1] * len(raw.flats) + [0] * len(raw.views)
            )
            every = np.concatenate([np.zeros(len(raw.darks) + len(raw.flats)), stored])
            theta = file.create_dataset('entry/sample/rotation_angle', data=every)
        theta.attrs['units'] = unit
    scan = load(path, scan_yml)
    check(scan, raw)
    np.testing.assert_allclose(np.degrees(scan.geometry.angles), angles)


def test_photons(tmp_path, scan_yml):
    """Twenty flats tell the photons to 5 %, the images to 15 %."""
    raw = raw_frames(shape=(96, 160))
    scan, history = import_raw(
        save(tmp_path, raw) and tmp_path / 'views.npy', scan_yml, Options(**save(tmp_path, raw)), False
    )
    assert history['photons_from_flats'] == pytest.approx(raw.photons, rel=0.05)
    assert photons_of_images(scan.projections, scan.valid) == pytest.approx(raw.photons, rel=0.15)


def test_without_noise_exact(tmp_path, scan_yml):
    """Rounding to counts is all that is left: half a count of 20 000 exp(-2)."""
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


def test_frames_of_different_sizes(tmp_path, raw, scan_yml):
    write_tiff_folder(tmp_path / 'v', raw.views)
    tifffile.imwrite(tmp_path / 'v' / 'a_3.tif', raw.views[3, :-1])
    with pytest.raises(lm.InputError, match=r'a_3.tif: has the shape \(23, 40\), but a_0.tif has \(24, 40\)'):
        load(tmp_path / 'v', scan_yml, **save(tmp_path, raw))


def test_damaged_frame(tmp_path, raw, scan_yml):
    write_tiff_folder(tmp_path / 'v', raw.views)
    (tmp_path / 'v' / 'a_2.tif').write_bytes(b'II*\0broken')
    with pytest.raises(lm.InputError, match='a_2.tif: is damaged'):
        load(tmp_path / 'v', scan_yml, **save(tmp_path, raw))


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
    """In floating-point darks or flats they are masked, and change nothing else."""
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


@pytest.mark.parametrize('content', ['number', 'group', 'text', 'angles'])
def test_files_of_another_structure(tmp_path, scan_yml, content):
    """One line, whatever they hold in the place of frames."""
    h5py = pytest.importorskip('h5py')
    path = tmp_path / ('a.npy' if content == 'number' else 'a.h5')
    if content == 'number':
        np.save(path, np.float32(3))
    else:
        with h5py.File(path, 'w') as file:
            if content == 'group':
                file.create_group('exchange/data')
            else:
                file['exchange/data'] = np.ones((2, 3, 4)) if content == 'angles' else 'frames'
                file['exchange/theta'] = 'a, b'
    with pytest.raises(InputError, match='a.npy|a.h5') as caught:
        load(path, scan_yml, i0=1.0)
    assert '\n' not in str(caught.value)


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


def test_a_stack_of_one_page(tmp_path):
    """ImageJ writes stacks of more than 4 GB so."""
    stack = np.random.default_rng(0).integers(100, 9000, (6, 8, 10)).astype(np.uint16)
    tifffile.imwrite(tmp_path / 'stack.tif', stack, truncate=True)
    views = open_recording(tmp_path / 'stack.tif').views
    assert len(views) == 6
    np.testing.assert_array_equal([views[i] for i in range(6)], stack)


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


def test_units_in_an_array_and_alignment_frames(tmp_path):
    h5py = pytest.importorskip('h5py')
    frames = np.arange(6 * 4 * 5, dtype=np.uint16).reshape(6, 4, 5)
    with h5py.File(tmp_path / 'scan.h5', 'w') as file:
        file['entry/instrument/detector/data'] = frames
        file['entry/instrument/detector/image_key'] = [0, 0, 0, 0, 0, 0]
        file['entry/instrument/detector/image_key_control'] = [0, 0, 0, 0, -1, -1]
        file['entry/sample/rotation_angle'] = np.radians([0, 90, 180, 270, 180, 0])
        file['entry/sample/rotation_angle'].attrs['units'] = np.array([b'rad'])
    recording = open_recording(tmp_path / 'scan.h5')
    assert len(recording.views) == 4
    np.testing.assert_allclose(recording.angles, [0, 90, 180, 270])


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


def test_colours_are_refused(tmp_path, scan_yml):
    tifffile.imwrite(tmp_path / 'rgb.tif', np.zeros((20, 30, 3), np.uint8), photometric='rgb')
    with pytest.raises(InputError, match='holds colours'):
        read_volume(tmp_path / 'rgb.tif')


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


@pytest.mark.parametrize('several', [False, True])
def test_a_cut_off_edf(tmp_path, raw, scan_yml, several):
    """fabio would fill up what is missing."""
    image = pytest.importorskip('fabio').edfimage.EdfImage(data=raw.views[0])
    if several:
        for frame in raw.views[1:]:
            image.append_frame(data=frame)
    (tmp_path / 'v').mkdir()
    path = tmp_path / 'v' / 'a.edf'
    image.write(str(path))
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(lm.InputError, match='a.edf: is cut off'):
        load(path if several else path.parent, scan_yml, **save(tmp_path, raw))


@pytest.mark.parametrize(('empty', 'message'), [('data_white', 'no flat frames; give flats=FILE'), ('data_dark', '')])
def test_dxchange_with_stacks_of_no_frames(tmp_path, raw, scan_yml, empty, message):
    with pytest.importorskip('h5py').File(tmp_path / 'a.h5', 'w') as file:
        for name, stack in dict(data=raw.views, data_white=raw.flats, data_dark=raw.darks).items():
            file[f'exchange/{name}'] = stack[:0] if name == empty else stack
    if message:
        with pytest.raises(lm.InputError, match=message):
            load(tmp_path / 'a.h5', scan_yml)
    else:
        assert len(load(tmp_path / 'a.h5', scan_yml)) == 6


@pytest.mark.parametrize('place', ['entry/instrument/detector/data', 'exchange/data'])
def test_frames_in_a_file_that_is_not_there(tmp_path, place):
    h5py = pytest.importorskip('h5py')
    path = tmp_path / 'scan.nxs'
    with h5py.File(path, 'w') as file:
        file.create_group(place.rpartition('/')[0])
        file[place] = h5py.ExternalLink('frames.h5', '/data')
    with pytest.raises(
        InputError, match=f'/{place} is a link to frames.h5, which is not there; put that file beside scan.nxs'
    ):
        open_recording(path)
    with h5py.File(tmp_path / 'frames.h5', 'w') as file:
        file['data'] = np.ones((4, 5, 6), np.uint16)
    assert open_recording(path).views.shape == (5, 6)


def test_kinds_of_frames_that_a_scan_is_not():
    """`read_scan`, in a package below, names `import` for what this one opens."""
    assert scans.FRAMES == {*frames.IMAGES, *frames.FILES} - {'.npy'}
