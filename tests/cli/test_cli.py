"""The command line from end to end, on a scene that fits in a second."""

import json
import runpy
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import nibabel
import numpy as np
import pytest

from helpers.fits import geometry, tiny_scan
from helpers.same import fits_alike
from helpers.script import FIT, SCENE, fit, fit_process, run
from lingo_mi.files.images import read_exr
from lingo_mi.files.ply import read_ply
from lingo_mi.files.scans import write_scan
from lingo_mi.files.volumes import write_volume
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.geometry.grid import Grid
from lingo_mi.geometry.trajectories import spread
from lingo_mi.metrics.quality import psnr_3d
from lingo_mi.projectors import grid
from lingo_mi.scene.load import defaults, load_scene
from lingo_mi.scene.simulate import take_scan
from lingo_mi.storage.output_folder import CHECKPOINT

SCENES = Path(__file__).parents[2] / 'scenes'
SMALL = '-D', 'n_points=300', '-D', 'densify_from=10', '-D', 'densify_every=10', '-D', 'densify_threshold=1e-4'
QUICK = '--iterations', '2', '-D', 'n_points=100'
KEYS = [
    'psnr_2d_r2',
    'psnr_2d',
    'ssim_2d',
    'ssim_2d_r2',
    'psnr_3d',
    'ssim_3d',
    'psnr_3d_r2',
    'ssim_3d_r2',
    'ipsd',
    'ipsd_targets',
    'gaussians',
    'iterations',
    'seconds_init',
    'seconds_fit',
    'ms_per_iteration',
    'variant',
    'method',
    'seed',
    'views',
    'versions',
    'history',
]


@pytest.fixture(scope='module')
def result(scene):
    """The folder, the metrics and the printed text of a fit of 60 iterations."""
    folder = scene.parent / 'made' / 'result'
    code, out, err = fit(scene, '--iterations', '60', '--out', folder, *SMALL, report=True)
    assert code == 0, err
    return folder, json.loads((folder / 'metrics.json').read_text()), out


def in_its_own_process(*arguments):
    """Run a whole fit whose sums do not depend on what this process has done before."""
    process = fit_process(*arguments)
    err = process.communicate()[1]
    assert process.returncode == 0, err


def metrics_of(folder):
    return json.loads((folder / 'metrics.json').read_text())


def test_everything_is_written(result):
    folder, _, out = result
    assert sorted(p.name for p in folder.iterdir()) == [
        '.lingo_mi.json',
        'checkpoint.npz',
        'gaussians.ply',
        'metrics.json',
        'report.html',
        'report.png',
        'result.xml',
        'views',
        'volume.nii.gz',
    ]
    assert sorted(p.name for p in (folder / 'views').iterdir()) == ['0000.exr', '0001.exr', '0002.exr']
    assert (folder / 'report.png').read_bytes().startswith(b'\x89PNG')
    assert '<html' in (folder / 'report.html').read_text()
    assert 'PSNR' in out and str(folder) in out


def test_metrics(result):
    _, metrics, _ = result
    assert set(KEYS) <= metrics.keys()
    assert metrics['iterations'] == 60 and metrics['views'] == 8
    assert metrics['method'] == 'fast' and metrics['seed'] == 0
    assert metrics['psnr_2d'] > 32 and metrics['psnr_3d'] > 26  # far beyond the initial cloud's 25 and 22 dB
    assert metrics['ipsd_targets'] > 0 and metrics['ipsd'] > 0
    assert metrics['history'][-1]['iteration'] == 60
    assert np.all(np.diff([h['seconds'] for h in metrics['history']]) > 0)
    assert metrics['variant'] == mi.variant() and metrics['versions']['mitsuba'].startswith('3.')


def test_volume_has_units_and_place(result, dataset):
    folder, metrics, _ = result
    image = nibabel.load(folder / 'volume.nii.gz')
    assert image.shape == (24, 24, 24) and image.header.get_xyzt_units()[0] == 'mm'
    assert np.allclose(image.affine, [[1, 0, 0, -11.5], [0, 1, 0, -11.5], [0, 0, 1, -11.5], [0, 0, 0, 1]])
    assert abs(psnr_3d(image.get_fdata(dtype=np.float32), dataset.volume) - metrics['psnr_3d']) < 1e-4


def test_cloud_loads_in_mitsuba(result):
    folder, metrics, _ = result
    centres, scales, _, density = read_ply(folder / 'gaussians.ply')
    assert len(density) == metrics['gaussians'] and np.abs(centres).max() <= 12 and scales.max() < 12
    params = mi.traverse(mi.load_dict(dict(type='ellipsoids', filename=str(folder / 'gaussians.ply'))))
    assert np.allclose(np.array(params['data']).reshape(-1, 10)[:, :3], centres, atol=1e-6)
    assert np.allclose(np.array(params['density']).ravel(), density)


def test_result_scene_renders_the_views(result):
    folder, metrics, _ = result
    program = textwrap.dedent(f"""
        from dataclasses import replace
        import mitsuba as mi
        import numpy as np
        import lingo_mi
        mi.set_variant({mi.variant()!r})
        scene = mi.load_file({str(folder / 'result.xml')!r})
        scanner = scene.sensors()[0]
        test = replace(scanner.geometry, angles=np.radians({metrics['test_angles']!r}))
        np.save({str(folder.parent / 'again.npy')!r},
                [mi.render(scene, sensor=scanner.view(i, test)).numpy()[..., 0] for i in range(len(test))])
    """)
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    again = np.load(folder.parent / 'again.npy')
    views = np.stack([read_exr(folder / 'views' / f'{i:04d}.exr') for i in range(3)])
    assert np.abs(again - views).max() < 1e-4 * views.max()


def test_refuses_to_overwrite(result, scene):
    folder, _, _ = result
    before = {p: p.stat().st_mtime_ns for p in folder.iterdir()}
    code, _, err = fit(scene, *QUICK, '--out', folder)
    assert code == 2 and err.startswith('error: ') and err.count('\n') == 1 and '--force' in err
    assert before == {p: p.stat().st_mtime_ns for p in folder.iterdir()}


def test_options(scene, tmp_path):
    out = tmp_path / 'a'
    out.mkdir()
    (out / 'old').touch()
    code, _, err = fit(
        scene,
        *QUICK,
        '--out',
        out,
        '--force',
        '--views',
        '3',
        '--seed',
        '5',
        '--method',
        'lingo',
        '--start',
        'fdk',
        '-D',
        'views=6',
        '-D',
        'rate_scale=0.1,0.2',
        '-D',
        'normalise=true',
    )
    assert code == 0, err
    metrics = metrics_of(out)
    assert metrics['views'] == 3 and metrics['seed'] == 5 and metrics['method'] == 'lingo'
    assert np.allclose(metrics['angles'], [0, 120, 240])
    settings = metrics['settings']
    assert settings['rate_scale'] == [0.1, 0.2] and settings['normalise'] is True and settings['start'] == 'fdk'


def test_scans_a_volume(scene, dataset, tmp_path):
    ct = dataset.volume[:, 2:20, 4:]
    write_volume(tmp_path / 'ct.nii.gz', ct, Grid(ct.shape, (0.75, 1, 1)))
    code, _, err = fit(scene, *QUICK, '--out', tmp_path / 'a', '--volume', tmp_path / 'ct.nii.gz')
    assert code == 0, err
    image = nibabel.load(tmp_path / 'a' / 'volume.nii.gz')
    assert image.shape == (24, 18, 20) and np.allclose(image.header.get_zooms(), (0.75, 1, 1))
    assert metrics_of(tmp_path / 'a')['psnr_3d'] is not None


@pytest.mark.parametrize('kind, name, held_out', [('naf', 'scan.pickle', 3), ('r2', 'scan', 3), ('npy', 'scan.npy', 0)])
def test_measured_projections(scene, dataset, tmp_path, kind, name, held_out):
    stored = dataset if held_out else replace(dataset, test=None, volume=None)
    write_scan(tmp_path / name, stored, kind)
    code, _, err = fit(scene, *QUICK, '--out', tmp_path / 'a', '--projections', tmp_path / name)
    assert code == 0, err
    metrics = metrics_of(tmp_path / 'a')
    assert metrics['views'] == 8 and np.allclose(metrics['angles'], np.arange(8) * 45)
    assert len(metrics['test_angles']) == held_out
    assert (metrics['psnr_2d'] is None) == (metrics['psnr_3d'] is None) == (not held_out)
    assert len(list((tmp_path / 'a').glob('views/*'))) == held_out


def test_unused_views_are_held_out(scene, dataset, tmp_path):
    write_scan(tmp_path / 'scan.npy', dataset.train, 'npy')
    code, _, err = fit(scene, *QUICK, '--out', tmp_path / 'a', '--projections', tmp_path / 'scan.npy', '--views', '5')
    assert code == 0, err
    metrics = metrics_of(tmp_path / 'a')
    chosen = spread(8, 5)
    assert np.allclose(metrics['angles'], chosen * 45)
    assert np.allclose(metrics['test_angles'], np.setdiff1d(np.arange(8), chosen) * 45)


# ---- interruptions ---------------------------------------------------------------------------------------------------


def wait_for(process, condition, seconds=300):
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.posix
@pytest.mark.thorough
def test_resume_after_kill(scene, tmp_path):
    """After `kill -9` in the middle, --resume gives the numbers of an uninterrupted fit. `test_crashes` has a shorter test."""
    out, whole = tmp_path / 'a', tmp_path / 'whole'
    in_its_own_process(scene, '--iterations', '60', '--out', whole, *SMALL)
    arguments = scene, '--iterations', '60', '--out', out, *SMALL
    process = fit_process(*arguments, '-D', 'checkpoint_seconds=0')
    wait_for(process, (out / 'checkpoint.npz').exists)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL and not (out / 'metrics.json').exists()
    assert 0 < Checkpoint.load(out / 'checkpoint.npz').iteration < 60
    in_its_own_process(*arguments, '--resume')
    whole, resumed = metrics_of(whole), metrics_of(out)
    for key in 'psnr_2d_r2', 'psnr_2d', 'ssim_2d', 'psnr_3d', 'ssim_3d', 'ipsd', 'gaussians', 'ipsd_targets':
        assert whole[key] is not None and resumed[key] == pytest.approx(whole[key], rel=fits_alike(1e-4)), key
    assert [h['iteration'] for h in resumed['history']] == [h['iteration'] for h in whole['history']]


@pytest.mark.posix
@pytest.mark.thorough
def test_resume_after_kills_in_a_search(scene, tmp_path):
    """--resume works after `kill -9` in the search for the step to stop at, and again after one on the way to that step."""
    arguments = scene, '--iterations', '60', *SMALL, '-D', 'stop=on', '-D', 'stop_every=5', '-D', 'stop_patience=15'
    in_its_own_process(*arguments, '--out', tmp_path / 'whole')
    out, more = tmp_path / 'a', []
    for searching in True, False:
        process = fit_process(*arguments, '--out', out, '-D', 'checkpoint_seconds=0', *more)
        wait_for(process, lambda: (path := out / CHECKPOINT).exists() and Checkpoint.load(path).searching == searching)
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL and not (out / 'metrics.json').exists()
        more = ['--resume']
    in_its_own_process(*arguments, '--out', out, '--resume')
    whole, resumed = metrics_of(tmp_path / 'whole'), metrics_of(out)
    for key in 'psnr_2d', 'ssim_2d', 'psnr_3d', 'ssim_3d', 'ipsd', 'gaussians', 'iterations':
        assert whole[key] is not None and resumed[key] == pytest.approx(whole[key], rel=fits_alike(1e-4)), key
    for key in 'best', 'iterations', 'errors':
        assert resumed['search'][key] == pytest.approx(whole['search'][key], rel=fits_alike(1e-4)), key


def test_interrupt_leaves_a_checkpoint(scene, tmp_path):
    out = tmp_path / 'a'
    # It says how far it is after a tenth, and would go on for nine times as long; no checkpoint but the one that Ctrl-C leaves.
    process = fit_process(scene, '--iterations', '2000', '--out', out, *SMALL, '-D', 'checkpoint_seconds=1e9')
    line = ''
    while not line.startswith('Fit: '):
        line = process.stderr.readline()
        assert line or process.poll() is None
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and '--resume' in err and 'Traceback' not in err
    assert sorted(p.name for p in out.iterdir()) == ['.lingo_mi.json', 'checkpoint.npz']


def test_interrupt_while_a_scene_loads(tmp_path):
    """Mitsuba turns the interrupt into an error of its own, in the plugin that makes a large phantom."""
    (tmp_path / 'slow.xml').write_text(
        SCENE.replace('<integer name="size" value="24"/>', '<integer name="size" value="400"/>')
    )
    program = textwrap.dedent(f"""
        import runpy, sys
        from lingo_mi import phantoms
        made = phantoms.make
        phantoms.make = lambda *args: (print('begun', file=sys.stderr, flush=True), made(*args))[1]
        sys.argv = {[str(FIT), str(tmp_path / 'slow.xml'), '--out', str(tmp_path / 'a'), '--variant', mi.variant()]!r}
        runpy.run_path(sys.argv[0], run_name='__main__')
    """)
    process = subprocess.Popen([sys.executable, '-c', program], stdout=-1, stderr=-1, text=True)
    while process.stderr.readline() != 'begun\n':
        assert process.poll() is None
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err.splitlines()[-1] == 'interrupted' and 'Traceback' not in err, err
    assert not (tmp_path / 'a').exists()


# ---- the scenes that come with the project ---------------------------------------------------------------------------


@pytest.mark.parametrize('path', sorted(SCENES.glob('*.xml')), ids=lambda path: path.stem)
def test_scene_loads(path, request):
    if {'volume', 'projections'} & defaults(path) and path.stem != 'x3d_foot':
        request.getfixturevalue('data')
    loaded = load_scene(path, {'size': '16'} if 'size' in defaults(path) else {})
    assert len(loaded.scanner.geometry) > 1
    text = path.read_text()
    assert text.startswith('<!-- ') and f'python scripts/fit.py scenes/{path.name}' in text


@pytest.mark.parametrize(
    'name, files', [('gaussians', ['gaussians.ply']), ('mesh', ['flange.ply', 'flange_bolts.ply'])]
)
def test_scene_files_are_the_phantoms(monkeypatch, tmp_path, name, files):
    """`phantom.py` writes again what the scenes read, and does not overwrite it unasked."""
    monkeypatch.setattr(sys, 'argv', ['phantom.py', name, '--size', '8', '--out', str(tmp_path / files[0])])
    for code in 0, 2:
        with pytest.raises(SystemExit) as stop:
            runpy.run_path(str(FIT.with_name('phantom.py')), run_name='__main__')
        assert stop.value.code == code
    for file in files:
        assert (tmp_path / file).read_bytes() == (SCENES / 'meshes' / file).read_bytes()


def test_metal_part_has_a_truth():
    """The voxels of a mesh scene are its metal: their exact projections match the projections of the meshes."""
    loaded = load_scene(SCENES / 'metal_part.xml')
    scanner = loaded.scanner
    scanner.geometry = replace(scanner.geometry, nDetector=(48, 48), dDetector=(10, 10), angles=np.array([0.3]))
    scanner.test_geometry = None
    scan = take_scan(loaded)
    again = grid.project_volume(scan.volume, scan.train.geometry)
    assert again.sum() == pytest.approx(scan.train.projections.sum(), rel=2e-3)
    assert np.abs(again - scan.train.projections).mean() < 0.04 * scan.train.projections.mean()  # blurred edges


def test_a_scan_in_the_place_of_a_scene(tmp_path, monkeypatch):
    """Results are named after the scan. It excludes --projections, and a missing scan is refused."""
    write_scan(tmp_path / 'hand.npy', tiny_scan(geometry(8)), 'npy')
    monkeypatch.chdir(tmp_path)
    code, text, err = fit('hand.npy', *QUICK)
    assert code == 0, err
    assert 'out/hand/: ' in text and metrics_of(tmp_path / 'out' / 'hand')['views'] == 8
    code, text, err = run(FIT.with_name('reconstruct.py'), 'hand.npy', '--algorithm', 'fdk')
    assert code == 0 and 'out/hand-fdk.nii.gz' in text, err
    code, _, err = fit('hand.npy', '--projections', 'hand.npy')
    assert code == 2 and 'hand.npy: is not a scene, which --projections and --volume go with' in err
    code, _, err = fit('foot.npy')
    assert code == 2 and 'foot.npy: there is no such scene' in err
