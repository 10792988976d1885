"""`lingo-mi fit` and `Fit.save` on a folder that already has files."""

import hashlib
import os
import shutil
from unittest import mock

import numpy as np
import pytest

import lingo_mi as lm
from helpers.script import FIT, fit, fit_process, run
from lingo_mi.files.volumes import write_volume
from lingo_mi.geometry.grid import Grid
from lingo_mi.storage.folder_lock import LOCK, locked
from lingo_mi.storage.output_folder import MANIFEST

QUICK = '--iterations', '2', '-D', 'n_points=100'


def undrawn():
    """A context in which reports are written without drawing their picture, which takes longer than all else."""
    return mock.patch('lingo_mi.report.figures.overview', return_value=b'a picture')


@pytest.fixture(scope='module')
def made(scene):
    folder = scene.parent / 'made'
    with undrawn():
        code, _, err = fit(scene, *QUICK, '--out', folder, report=True)
    assert code == 0, err
    return folder


@pytest.fixture
def result(made, tmp_path):
    """A copy of a result, to be spoiled."""
    return shutil.copytree(made, tmp_path / 'result')


def contents(folder):
    return {p: hashlib.sha256(p.read_bytes()).digest() for p in sorted(folder.rglob('*')) if p.is_file()}


def refused(code, err, *words):
    assert code == 2 and err.count('\n') == 1 and err.startswith('error: '), err
    assert len(err) < 308 and all(word in err for word in words), err


@pytest.mark.thorough
def test_force_leaves_foreign_files_alone(scene, result):
    mine = [result / '.writable', result / 'views' / 'mine.exr', result / 'metrics.json.partial', result / 'notes']
    for path in mine:
        path.write_text('mine')
    code, _, err = fit(scene, *QUICK, '--seed', 3, '--out', result, '--force', '-D', 'views=4')
    assert code == 0 and all(path.read_text() == 'mine' for path in mine), err
    assert lm.load_fit(result).checkpoint.seed == 3


@pytest.mark.parametrize('name', ['result.xml', 'report.html', 'views', 'metrics.json', 'views/0001.exr', MANIFEST])
def test_force_does_not_follow_links(scene, result, tmp_path, name):
    target = tmp_path / 'target'
    shutil.move(result / name, target)
    (result / name).symlink_to(target)
    before = contents(tmp_path)
    code, _, err = fit(scene, *QUICK, '--out', result, '--force')
    refused(code, err.splitlines(True)[-1], name, 'link')
    assert 'Fit' not in err, 'it has worked in vain'
    assert contents(tmp_path) == before


@pytest.mark.parametrize('name', ['result.xml', 'metrics.json', 'checkpoint.npz', 'views/0002.exr', 'report.png'])
def test_force_refuses_a_foreign_file_of_a_name_that_it_needs(scene, tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text('mine')
    code, _, err = fit(scene, *QUICK, '--out', tmp_path, '--force')
    refused(code, err.splitlines(True)[-1], name, 'was not written by lingo_mi')
    assert 'Fit' not in err and contents(tmp_path).keys() == {path} and path.read_text() == 'mine'


def test_an_empty_folder_but_for_leftovers(scene, tmp_path):
    """A process killed before its first checkpoint leaves neither a result nor a fit that can be resumed."""
    leftover = tmp_path / f'.lingo_mi-{16 * "0"}-checkpoint.npz'
    for path in (leftover, tmp_path / LOCK):
        path.touch()
    code, _, err = fit(scene, *QUICK, '--out', tmp_path, '--resume')
    refused(code, err, 'no checkpoint', 'run without --resume')
    assert '--force' not in err
    code, _, err = fit(scene, *QUICK, '--out', tmp_path)
    assert code == 0 and not leftover.exists(), err


def test_advice_that_helps(scene, tmp_path):
    (tmp_path / 'notes').touch()
    code, _, err = fit(scene, *QUICK, '--out', tmp_path)
    refused(code, err, 'is not empty', '--force')
    assert '--resume' not in err
    code, _, err = fit(scene, *QUICK, '--out', tmp_path, '--resume')
    refused(code, err, 'run without --resume, with --force')


def test_one_writer_at_a_time(scene, result, tmp_path):
    before = contents(result)
    loaded = lm.load_fit(result)
    with locked(result):
        code, _, err = fit(scene, *QUICK, '--out', result, '--force')
        refused(code, err.splitlines(True)[-1], str(os.getpid()), 'is writing there')
        assert 'Fit' not in err
        with pytest.raises(lm.InputError, match='is writing there'):
            loaded.save(result, force=True)
        assert contents(result).keys() - before.keys() == {result / LOCK}
    assert contents(result) == before


@pytest.mark.thorough
def test_a_killed_fit_holds_no_lock(scene, tmp_path):
    long = scene, '--iterations', '1000000', '-D', 'n_points=100', '--out', tmp_path / 'a'
    process = fit_process(*long, '-D', 'checkpoint_seconds=0')
    while not (tmp_path / 'a' / 'checkpoint.npz').exists():
        assert process.poll() is None
    code, _, err = fit(*long, '--force')
    refused(code, err.splitlines(True)[-1], f'process {process.pid} on', 'is writing there')
    process.kill()
    process.communicate()
    code, _, err = fit(scene, *QUICK, '--out', tmp_path / 'a', '--force')
    assert code == 0, err


@pytest.mark.parametrize('option', ['--complete', '--start'])
@pytest.mark.parametrize('name', ['result.xml', 'gaussians.ply'])
def test_parts_of_two_results_are_refused(scene, result, tmp_path, name, option):
    script = FIT.with_name('reconstruct.py')
    code, _, err = fit(scene, *QUICK, '--seed', 5, '--out', tmp_path / 'other', '-D', 'extent=2')
    assert code == 0, err
    shutil.copy(tmp_path / 'other' / name, result / name)
    more = ('--views', 12) if option == '--complete' else ()
    arguments = scene, '--algorithm', 'refined', option, result / 'result.xml', '--out', tmp_path / 'v.nii', *more
    code, _, err = run(script, *arguments)
    refused(code, err, name, 'does not match metrics.json')
    with pytest.raises(lm.InputError, match='does not match'):
        lm.load_fit(result)
    (result / 'metrics.json').unlink()  # as where a result was begun over another
    (result / MANIFEST).write_text((result / MANIFEST).read_text().replace('false', 'true'))
    code, _, err = run(script, *arguments)
    refused(code, err, 'not completed')
    with pytest.raises(lm.InputError, match='not completed'):
        lm.load_fit(result)
    assert len(lm.load_fit(result / 'checkpoint.npz')) == 100


def test_a_volume_is_written_by_one(scene, tmp_path):
    out, script = tmp_path / 'v.nii', FIT.with_name('reconstruct.py')
    leftover, other = (tmp_path / f'.lingo_mi-{16 * "b"}-{name}' for name in ('v.nii', 'w.nii'))
    leftover.touch()
    other.touch()
    with locked(tmp_path, f'{LOCK}-v.nii'):
        code, _, err = run(script, scene, '--out', out)
        refused(code, err, 'is writing there')
        code, _, err = run(script, scene, '--out', tmp_path / 'w.nii')
        assert code == 0, err
    code, _, err = run(script, scene, '--out', out)
    assert code == 0 and {p.name for p in tmp_path.iterdir()} == {'v.nii', 'w.nii'}, err
    target = tmp_path / 'mine.nii'
    out.rename(target)
    out.symlink_to(target)
    code, _, err = run(script, scene, '--out', out, '--force')
    refused(code, err, 'is a link')
    assert out.is_symlink()


def test_files_copied_from_a_result_are_read(scene, result, tmp_path):
    (tmp_path / 'copy').mkdir()
    for name in ('result.xml', 'gaussians.ply', 'checkpoint.npz'):
        shutil.copy(result / name, tmp_path / 'copy' / name)
    script = FIT.with_name('reconstruct.py')
    arguments = scene, '--algorithm', 'voxelize', '--complete', tmp_path / 'copy' / 'result.xml'
    code, _, err = run(script, *arguments, '--out', tmp_path / 'v.nii')
    assert code == 0, err


def test_save_goes_by_the_same_rules(result, tmp_path):
    loaded = lm.load_fit(result)
    (tmp_path / 'new' / 'views').mkdir(parents=True)
    (tmp_path / 'new' / 'report.html').write_text('mine')
    with pytest.raises(lm.InputError, match='not empty'):
        loaded.save(tmp_path / 'new')
    with pytest.raises(lm.InputError, match='not written by lingo_mi'):
        loaded.save(tmp_path / 'new', force=True)
    assert sorted(contents(tmp_path / 'new')) == [tmp_path / 'new' / 'report.html']
    (result / 'volume.nii.gz').write_bytes(b'')
    (result / 'views' / 'mine.exr').write_text('mine')
    with undrawn():
        loaded.save(result, force=True)
    assert sorted(p.name for p in (result / 'views').iterdir()) == ['0000.exr', '0001.exr', '0002.exr', 'mine.exr']
    np.testing.assert_array_equal(lm.load_fit(result).gaussians.means, loaded.gaussians.means)


@pytest.mark.parametrize(
    'name',
    [
        b'<script>alert(1)<script>\n\x1b[31m',
        *(pytest.param(n, marks=pytest.mark.thorough) for n in (b'$\\frac{a$', b'\xff\xfe', b'a' * 200)),
    ],
)
def test_no_result_depends_on_a_name(scene, tmp_path, name):
    """Names of a volume and of the folder are written, and shown as text."""
    volume, out = tmp_path / os.fsdecode(name + b'.nii.gz'), tmp_path / os.fsdecode(name)
    write_volume(volume, np.random.default_rng(0).random((12, 12, 12)), Grid(12, 1))
    code, text, err = fit(scene, *QUICK, '--volume', volume, '--out', out, report=True)
    assert code == 0 and 'warning' not in err, err
    page = (out / 'report.html').read_text(encoding='utf-8')
    assert '<script>alert' not in page and {'metrics.json', 'report.png'} <= {p.name for p in out.iterdir()}
    loaded = lm.load_fit(out)
    with undrawn():
        loaded.save(tmp_path / 'again')
    assert '<script>alert' not in (tmp_path / 'again' / 'report.html').read_text(encoding='utf-8')
    assert sorted(p.name for p in (out / 'views').iterdir()) == ['0000.exr', '0001.exr', '0002.exr']


def test_a_report_that_cannot_be_drawn_is_a_warning(scene, result):
    with mock.patch('lingo_mi.report.figures.overview', side_effect=RuntimeError('no\nfont')):
        code, _, err = fit(scene, *QUICK, '--seed', 6, '--out', result, '--force', report=True)
    assert code == 0 and [line for line in err.splitlines() if line.startswith('warning: ')], err
    assert 'report could not be drawn (no font)' in err and 'Traceback' not in err
    assert lm.load_fit(result).checkpoint.seed == 6
    assert not {'report.png', 'report.html'} & {p.name for p in result.iterdir()}, 'the old one would lie'


@pytest.mark.thorough
def test_a_home_and_caches_that_cannot_be_written(scene, tmp_path):
    """A fit does without them; even root cannot write to these."""
    nowhere = dict.fromkeys(('HOME', 'XDG_CACHE_HOME', 'XDG_CONFIG_HOME', 'MPLCONFIGDIR'), '/proc/none')
    nowhere['CUDA_ON_CPU_CACHE'] = str(tmp_path / 'kernels')  # of a stand-in for the driver, which cannot do without
    process = fit_process(scene, *QUICK, '--out', tmp_path / 'a', env=os.environ | nowhere)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 0 and 'Traceback' not in err, err
    assert {'metrics.json', 'report.html', 'volume.nii.gz'} <= {p.name for p in (tmp_path / 'a').iterdir()}
