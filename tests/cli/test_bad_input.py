"""Every bad input gives one line that starts with `error:`, exit code 2, and nothing half-made."""

import os
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from helpers.script import FIT, SCENE, fit
from lingo_mi.files.scans import write_scan
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.scan import Scan

QUICK = '--iterations', '2', '-D', 'n_points=100'


@pytest.fixture(scope='module')
def scan():
    """Measured projections of nothing in particular."""
    geometry = CircularGeometry(
        DSO=100, DSD=150, nDetector=(8, 10), dDetector=4, angles=np.arange(6.0), grid=Grid(16, 1)
    )
    return Scan(geometry, np.full((6, 8, 10), 3, np.float32))


def refused(tmp_path, *args, out=None):
    """The one line by which `fit.py ARGS` refuses."""
    out = tmp_path / 'new' / 'folder' if out is None else out
    code, printed, err = fit(*args, '--out', out, *QUICK)
    lines = [line for line in err.splitlines() if not line.startswith(('Scan: ', 'Fit: ', 'warning: '))]
    assert code == 2 and len(lines) == 1 and lines[0].startswith('error: '), (code, err)
    assert 'Traceback' not in err and 'RuntimeError' not in err and printed == ''
    assert not (tmp_path / 'new').exists()
    return lines[0]


# ---- scenes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'text, says',
    [
        ('', 'not a scene in XML'),
        ('DSO = 1000', 'not a scene in XML'),
        (SCENE.replace('</sensor>', ''), 'not a scene in XML'),
        ('<html><body/></html>', 'version'),
        ('<bsdf type="diffuse" version="3.0.0"/>', 'not a scene'),
        ('<scene version="3.0.0"/>', 'add <sensor type="ct_scanner">'),
        ('<scene version="3.0.0"><sensor type="perspective"/></scene>', 'add <sensor type="ct_scanner">'),
    ],
)
def test_not_a_scene(tmp_path, text, says):
    (tmp_path / 'scene.xml').write_text(text)
    assert says in refused(tmp_path, tmp_path / 'scene.xml')


@pytest.mark.posix
def test_missing_scene(tmp_path):
    assert 'none.xml' in refused(tmp_path, tmp_path / 'none.xml')
    assert f'{tmp_path}: has neither meta_data.json' in refused(tmp_path, tmp_path)  # as a scan in the place of a scene
    assert 'none.xml' in refused(tmp_path, tmp_path / 'none.xml', '-D', 'size=16')
    assert 'a device or a pipe' in refused(tmp_path, '/dev/zero')


@pytest.mark.parametrize(
    'old, new, says',
    [
        ('<integer name="test_views" value="3"/>', '<float name="sod" value="3"/>', 'sod'),
        ('name="DSO"', 'name="DS0"', 'DSO is missing'),
        (
            '<integrator type="lingo_xray"/>',
            '<integrator type="lingo_xray"><float name="cut" value="3"/></integrator>',
            'cut',
        ),
        ('name="size"', 'name="sise"', 'sise'),
        ('name="phantom" value="foot"', 'name="phantom" value="hand"', 'hand'),
        ('name="phantom" value="foot"', 'name="filename" value="no.nii.gz"', 'LINGO_MI_DATA'),
        ('<string name="phantom" value="foot"/>', '', 'either a filename or a phantom'),
        ('<string name="phantom" value="foot"/>', '<float name="phantom" value="3"/>', 'phantom'),
        ('type="ct_volume"', 'type="ct_volum"', 'ct_volum'),
        ('type="ct_scanner"', 'type="ct_scaner"', 'ct_scaner'),
        ('type="ct_volume" name="interior"', 'type="homogeneous" name="interior"', ''),
        ('name="DSO" value="100"', 'name="DSO" value="far"', 'far'),
        ('name="DSO" value="100"', 'name="DSO" value="200"', 'DSD >= DSO'),
        ('name="DSO" value="100"', 'name="DSO" value="nan"', 'DSO'),
        ('name="DSO" value="100"', 'name="DSO" value="13"', 'source'),
        ('<float name="DSO" value="100"/>', '<string name="DSO" value="100, 100"/>', 'DSO must be one number'),
        ('<integer name="views" value="$views"/>', '<float name="views" value="3.5"/>', 'views'),
        ('<integer name="views" value="$views"/>', '<string name="views" value="many"/>', 'views'),
        ('<integer name="views" value="$views"/>', '<string name="angles" value="1, x"/>', 'angles'),
        ('<integer name="views" value="$views"/>', '<string name="angles" value=""/>', 'view'),
        ('<integer name="views" value="$views"/>', '<integer name="views" value="1000000000"/>', 'at most'),
        ('value="$views"', 'value="0"', 'at least one view'),
        ('value="$views"', 'value="-3"', 'at least one view'),
        ('value="$views"', 'value="$vews"', 'vews'),
        ('<integer name="test_views" value="3"/>', '<integer name="test_views" value="-3"/>', 'test_views'),
        ('<integer name="test_views" value="3"/>', '<string name="startAngle" value="a"/>', 'startAngle'),
        ('<integer name="test_views" value="3"/>', '<float name="mode" value="3"/>', 'mode'),
        ('<integer name="test_views" value="3"/>', '<string name="mode" value="helix"/>', 'mode'),
        ('<integer name="test_views" value="3"/>', '<film type="hdrfilm"/>', 'film'),
        ('<integer name="test_views" value="3"/>', '<string name="projections" value="no.pickle"/>', 'no.pickle'),
        ('value="32, 40"', 'value="32.5, 40"', 'whole numbers'),
        ('value="32, 40"', 'value="nan, 40"', 'whole numbers'),
        ('value="32, 40"', 'value="0, 40"', 'positive'),
        ('value="32, 40"', 'value="1, 2, 3"', 'nDetector'),
        ('value="24, 24, 24"', 'value="24, -24, 24"', 'positive'),
        ('value="24, 24, 24"', 'value="inf, 24, 24"', 'whole numbers'),
        ('value="24, 24, 24"', 'value="100000, 100000, 100000"', 'GiB of memory'),
        ('value="32, 40"', 'value="1000000, 1000000"', 'GiB of memory'),
        ('value="1.8, 1.8"', 'value="0"', 'positive'),
    ],
)
def test_bad_scene(tmp_path, monkeypatch, old, new, says):
    monkeypatch.delenv('LINGO_MI_DATA', raising=False)
    assert SCENE.count(old) == 1
    (tmp_path / 'scene.xml').write_text(SCENE.replace(old, new))
    assert says in refused(tmp_path, tmp_path / 'scene.xml')


def test_a_cloud_of_nothing(tmp_path):
    """Mitsuba itself would fail with operands of incompatible sizes."""
    from lingo_mi.files.ply import _PROPERTIES

    (tmp_path / 'empty.ply').write_text(
        '\n'.join(
            [
                'ply',
                'format binary_little_endian 1.0',
                'element vertex 0',
                *(f'property float {name}' for name in _PROPERTIES),
                'end_header',
                '',
            ]
        )
    )
    start, end = SCENE.index('<shape'), SCENE.index('</shape>')
    (tmp_path / 'scene.xml').write_text(
        SCENE[:start] + '<shape type="ellipsoids"><string name="filename" value="empty.ply"/>' + SCENE[end:]
    )
    assert 'holds no Gaussian' in refused(tmp_path, tmp_path / 'scene.xml')


# ---- arguments -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'args, says',
    [
        (['-D', 'lambda_tb=1'], 'did you mean lambda_tv?'),
        (['-D', 'wavelet=1'], 'the documentation of the methods lists those'),
        (['-D', 'vews=3'], '(views)'),
        (['-D', 'views'], 'name=value'),
        (['-D', '=3'], 'name=value'),
        (['-D', 'views=many'], 'many'),
        (['-D', 'batch=many'], 'whole number'),
        (['-D', 'batch=0'], 'batch'),
        (['-D', 'batch=1.5'], 'whole number'),
        (['-D', 'normalise=perhaps'], 'true or false'),
        (['-D', 'extent=99'], 'extent'),
        (['-D', 'rate_scale=1,2,3'], 'rate_scale'),
        (['-D', 'rate_scale=-1'], 'rate_scale'),
        (['-D', 'lambda_tv=nan'], 'lambda_tv'),
        (['-D', 'iterations=0'], 'iterations'),
        (['-D', 'n_points=-1'], 'n_points'),
        (['--iterations', '0'], 'iterations'),
        (['--views', '-1'], '--views'),
        (['--views', '0'], '--views'),
        (['--views', '9'], '9 views'),
        (['--views', 'x'], '--views'),
        (['--method', 'magic'], "there is no method 'magic'"),
        (['--method', 'lnigo'], "there is no method 'lnigo', did you mean lingo?"),
        (['--start', 'magic'], "not 'magic'"),
        (['--variant', 'magic'], 'variant'),
        (['--variant', 'scalar_rgb'], 'variant'),
        (['--frobnicate'], 'unrecognized arguments: --frobnicate (see'),
        (['--itterations', '5'], '--itterations 5, did you mean --iterations?'),
        (['--units', 'huu'], 'did you mean hu?'),
        (['--projections', 'a.pickle', '--volume', 'b.nii'], 'exclude'),
        (['--projections', ''], '--projections names no file'),
        (['--volume', ''], '--volume names no file'),
        (['--iterations', '3', '-D', 'iterations=4'], 'leave one of them out'),
        (['-D', 'start=fdk', '--start', 'fdk'], '--start'),
        (['--mu-water', '0.02'], '--volume'),
        (['--units', 'hu'], 'give --mu-water 0.0206'),
        (['--hold-out', '1'], '--hold-out 1 leaves no view'),
        (['--spacing', '0.5'], '--volume'),
        (['--resume'], 'no checkpoint'),
        (['--seed', '-1'], 'seed'),
        (['--seed', '9' * 400], '--seed'),
        (['--iterations', '9' * 400], 'iterations must lie in'),
        (['--views', '9' * 400], 'views'),
        (['-D', 'batch=1e9'], 'batch must lie in'),
        (['-D', 'batch=9'], 'at most the 8 of the scan, not 9'),
        (['-D', 'tv_stride=1e300'], 'tv_stride must lie in'),
        (['-D', 'rate_pose=1e300'], 'rate_pose must lie in'),
        (['-D', 'views=' + '9' * 400], '999'),
        *(
            (['--volume', 'a.raw', '--dtype', text], '--dtype must be')
            for text in (',', 'O', 'U5', 'c8', 'i4,i4', 'magic')
        ),
    ],
)
def test_bad_arguments(scene, tmp_path, args, says):
    code, _, err = fit(scene, *args, '--out', tmp_path / 'new' / 'folder')
    lines = [line for line in err.splitlines() if not line.startswith('Scan: ')]
    assert code == 2 and len(lines) == 1 and lines[0].startswith('error: ') and says in lines[0], (code, err)
    assert len(lines[0]) < 310
    assert not (tmp_path / 'new').exists()


def test_bad_output_folder(scene, tmp_path):
    (tmp_path / 'file').touch()
    assert 'not a folder' in refused(tmp_path, scene, out=tmp_path / 'file')
    assert 'cannot write' in refused(tmp_path, scene, out=tmp_path / 'file' / 'below')
    assert 'cannot write' in refused(tmp_path, scene, out='/proc/lingo_mi')


def test_bad_checkpoints(scene, tmp_path):
    out = tmp_path / 'a'
    assert fit(scene, *QUICK, '--out', out)[0] == 0
    assert 'seed' in refused(tmp_path, scene, '--resume', '--seed', '1', out=out)
    assert 'views' in refused(tmp_path, scene, '--resume', '--views', '4', out=out)
    assert 'extent' in refused(tmp_path, scene, '--resume', '-D', 'extent=4', out=out)
    nearer = tmp_path / 'nearer.xml'
    nearer.write_text(scene.read_text().replace('name="DSO" value="100"', 'name="DSO" value="95"'))
    assert 'the geometry' in refused(tmp_path, nearer, '--resume', out=out)
    whole = (out / 'checkpoint.npz').read_bytes()
    broken = bytearray(whole)
    broken[len(whole) // 2] ^= 255
    with np.load(out / 'checkpoint.npz') as file:
        arrays = dict(file)
    for content in (b'', b'no checkpoint', whole[: len(whole) // 2], bytes(broken)):
        (out / 'checkpoint.npz').write_bytes(content)
        assert 'not a checkpoint' in refused(tmp_path, scene, '--resume', out=out)
    for name, value in (
        ('values.centre', arrays['values.centre'][:-1]),
        ('extra', np.array('{}')),
        ('values.scale', arrays['values.scale'] * np.nan),
    ):
        np.savez(out / 'checkpoint.npz', **{**arrays, name: value})
        assert 'not a checkpoint' in refused(tmp_path, scene, '--resume', out=out)
    assert (out / 'metrics.json').exists()  # the earlier result is as it was


# ---- volumes ---------------------------------------------------------------------------------------------------------


def damaged(volume, kind):
    volume = volume.copy()
    if kind == 'NaN':
        volume[3, 4, 5] = np.nan
    return {'NaN': volume, 'flat': volume[0], 'empty': volume[:0], 'zero': volume * 0, 'text': np.array('density')}[
        kind
    ]


@pytest.mark.parametrize('kind', ['NaN', 'flat', 'empty', 'zero', 'text'])
def test_bad_volume(scene, tmp_path, kind):
    np.save(tmp_path / 'ct.npy', damaged(np.ones((8, 8, 8), np.float32), kind))
    assert 'ct.npy' in refused(tmp_path, scene, '--volume', tmp_path / 'ct.npy')


@pytest.mark.parametrize(
    'name, content',
    [
        ('ct.nii.gz', b'\x1f\x8b\x08\x00truncated'),
        ('ct.nii', b'not a header'),
        ('ct.npy', b'\x93NUMPY\x01'),
        ('ct.raw', b'123'),
        ('ct.txt', b'1 2 3'),
        ('ct.mha', b'ObjectType = Image\n'),
        ('ct.tif', b'II*\0'),
    ],
)
def test_damaged_volume_file(scene, tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert name in refused(tmp_path, scene, '--volume', tmp_path / name)


def test_more_bad_volumes(scene, tmp_path):
    assert 'no such file' in refused(tmp_path, scene, '--volume', tmp_path / 'none.nii.gz')
    np.save(tmp_path / 'ct.npy', np.ones((8, 8, 8)))
    assert 'mu_water' in refused(tmp_path, scene, '--volume', tmp_path / 'ct.npy', '--mu-water', '-1')
    (tmp_path / 'ct.raw').write_bytes(bytes(8))
    assert 'bytes' in refused(tmp_path, scene, '--volume', tmp_path / 'ct.raw', '--shape', 2, 2, 3, '--dtype', 'uint8')
    assert 'dtype' in refused(tmp_path, scene, '--volume', tmp_path / 'ct.raw', '--shape', 2, 2, 2, '--dtype', 'magic')
    (tmp_path / 'slices').mkdir()
    assert 'slices' in refused(tmp_path, scene, '--volume', tmp_path / 'slices')
    assert 'dtype' in refused(tmp_path, scene, '--volume', tmp_path / 'ct.npy', '--shape', 8, 8, 8)
    # A volume as wide as the source's orbit.
    np.save(tmp_path / 'ct.npy', np.ones((220, 220, 2)))
    assert 'source' in refused(tmp_path, scene, '--volume', tmp_path / 'ct.npy')


# ---- projections -----------------------------------------------------------------------------------------------------


class _Runs:
    """An object that makes a file if it is unpickled carelessly."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), 'w')


def test_pickle_runs_no_code(scene, tmp_path):
    with open(tmp_path / 'scan.pickle', 'wb') as file:
        pickle.dump({'train': _Runs(tmp_path / 'made')}, file)
    assert 'do not trust this file' in refused(tmp_path, scene, '--projections', tmp_path / 'scan.pickle')
    assert not (tmp_path / 'made').exists()


@pytest.mark.parametrize(
    'kind, says',
    [
        ('NaN', 'NaN'),
        ('shape', 'shape'),
        ('zero', 'zero everywhere'),
        ('negative', 'nowhere above zero'),
        ('none', 'non-empty array'),
        ('no geometry', 'geometry'),
        ('key', 'nDetektor'),
        ('angles', 'angles'),
        ('truncated', 'damaged'),
        ('huge', 'GiB of memory'),
    ],
)
def test_bad_projections(scene, scan, tmp_path, kind, says):
    path, factor = tmp_path / 'scan.npy', {'zero': 0, 'negative': -1}.get(kind, 1)
    write_scan(path, replace(scan, projections=scan.projections * factor), 'npy')
    p, text = scan.projections.copy(), path.with_suffix('.yml').read_text()
    if kind in ('NaN', 'shape', 'none'):
        p[2, 3, 4] = np.nan
        np.save(path, {'NaN': p, 'shape': scan.projections[:, :-1], 'none': p[:0]}[kind])
    elif kind == 'truncated':
        path.write_bytes(path.read_bytes()[:200])
    elif kind == 'no geometry':
        path.with_suffix('.yml').unlink()
    elif factor == 1:
        old, new = {
            'key': ('nDetector', 'nDetektor'),
            'angles': ('angles:', 'angles: [1, 2]\nmode: cone #'),
            'huge': ('nVoxel: [16, 16, 16]', 'nVoxel: [99999, 99999, 99999]'),
        }[kind]
        assert old in text
        path.with_suffix('.yml').write_text(
            text.replace('mode: cone\n', '').replace(old, new) if kind == 'angles' else text.replace(old, new)
        )
    assert says in refused(tmp_path, scene, '--projections', path)


@pytest.mark.parametrize(
    'name', ['none.pickle', 'none', 'none.npy', 'scan.txt', 'empty.pickle', 'list.pickle', 'folder']
)
def test_no_projections(scene, tmp_path, name):
    (tmp_path / 'scan.txt').write_text('1 2 3')
    (tmp_path / 'empty.pickle').touch()
    (tmp_path / 'list.pickle').write_bytes(pickle.dumps([1, 2]))
    (tmp_path / 'folder').mkdir()
    assert name in refused(tmp_path, scene, '--projections', tmp_path / name)


def test_too_many_views_of_a_file(scene, scan, tmp_path):
    write_scan(tmp_path / 'scan.npy', scan, 'npy')
    assert '7 views' in refused(tmp_path, scene, '--projections', tmp_path / 'scan.npy', '--views', '7')


# ---- the machine -----------------------------------------------------------------------------------------------------


def test_without_llvm(scene, tmp_path):
    done = subprocess.run(
        [sys.executable, str(FIT), str(scene), '--variant', 'llvm_ad_mono', '--out', str(tmp_path / 'new')],
        env=os.environ | dict(PATH='', DRJIT_LIBLLVM_PATH='/nonexistent/libLLVM.so'),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and 'karellen-llvm-core' in done.stderr and 'Traceback' not in done.stderr
    assert done.stderr.splitlines()[-1].startswith('error: ')  # below Dr.Jit's own lines
    assert not (tmp_path / 'new').exists()


def test_a_folder_of_raw_frames_names_import(tmp_path):
    (tmp_path / 'frames').mkdir()
    for i in range(3):
        (tmp_path / 'frames' / f'{i}.tif').write_bytes(b'II')
    message = refused(tmp_path, tmp_path / 'frames')
    assert 'holds raw frames; make a scan of them: lingo-mi import' in message
