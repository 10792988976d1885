"""Input that scripts/reconstruct.py refuses in one line, and input that it warns of."""

from dataclasses import replace

import pytest

from helpers.script import RECONSTRUCT, changed_scene, load, run
from lingo_mi.files.scans import write_scan
from lingo_mi.scan import Scan


@pytest.mark.parametrize('option', ['--complete', '--start'])
def test_an_unset_variable_of_the_shell(scene, tmp_path, option):
    code, _, err = run(RECONSTRUCT, scene, '--algorithm', 'sart', option, '', '--out', tmp_path / 'v.nii')
    assert code == 2 and f'{option} names no file' in err and not (tmp_path / 'v.nii').exists()


@pytest.mark.parametrize(
    'args, message',
    [
        (['--views', '99'], 'the scan has 8'),
        (['--views', '-1'], '--views'),
        (['-D', 'nitre=3'], 'nitre'),
        (['--algorithm', 'cgls', '-D', 'niter=three'], "-D niter must be a whole number, not 'three'"),
        (['--algorithm', 'cgls', '-D', 'niter=2.5'], '-D niter must be a whole number'),
        (['--algorithm', 'sart', '-D', 'noneg=2'], 'noneg must be true or false'),
        (['-D', 'effects=some'], "'model' or 'ignore'"),
        (['--algorithm', 'sart', '-D', 'lmbda=5'], 'lmbda'),
        (['--algorithm', 'sart', '-D', 'OrderStrategy=sorted'], 'ordered, random, angularDistance'),
        (['--algorithm', 'sart', '-D', 'seed=-1'], 'seed must be'),
        (['--algorithm', 'asd-pocs', '-D', 'alpha=inf'], 'alpha must'),
        (['-D', 'filter=box'], 'ram-lak'),
        (['--out', 'v.npy'], '.nii'),
        (['--algorithm', 'voxelize'], '--complete'),
        (['--views', '0'], '--views must be at least 1'),
        (['--algorithm', 'voxelize', '--complete', 'no.xml', '--views', '9'], 'leave out --views'),
        (['--out', '/proc/v.nii'], 'cannot write'),
        (['--algorithm', 'refined'], '--complete'),
        (['--algorithm', 'best', '--start', 'x.xml'], 'leave out --complete and --start'),
        (['--start', 'no.xml'], 'iterative'),
        (['--algorithm', 'sart', '-D', 'weights=2'], '-D weights: neither'),
        (['--algorithm', 'sart', '--start', 'no.xml', '--views', '9'], 'iterative'),
        (['--algorithm', 'sart', '--start', 'no.xml'], 'there is no fit here'),
        (['--complete', 'no.xml'], '--views'),
        (['--complete', 'no.xml', '--views', '9'], 'there is no fit here'),
        (['--volume', 'a', '--projections', 'b'], 'exclude'),
        (['--algorithm', 'art'], 'art'),
        (['--seed', '-1'], '--seed'),
        (['--projections', 'no.npy'], 'no.npy'),
    ],
)
def test_bad_input_is_one_line(scene, tmp_path, args, message):
    out = [] if '--out' in args else ['--out', tmp_path / 'new' / 'v.nii.gz']
    code, _, err = run(RECONSTRUCT, scene, *args, *out)
    lines = [line for line in err.splitlines() if line.startswith('error')]
    assert code == 2 and len(lines) == 1 and message in lines[0], err
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten(scene, tmp_path):
    out = tmp_path / 'v.nii.gz'
    out.write_text('mine')
    code, _, err = run(RECONSTRUCT, scene, '--out', out)
    assert code == 2 and '--force' in err and out.read_text() == 'mine'
    assert run(RECONSTRUCT, scene, '--out', out, '--force')[0] == 0 and load(out).shape == (24, 24, 24)


def refused(*args):
    """The one line by which reconstruct.py refuses its input."""
    code, _, err = run(RECONSTRUCT, *args)
    lines = [line for line in err.splitlines() if not line.startswith(('Scan: ', 'warning: '))]
    assert code == 2 and len(lines) == 1 and lines[0].startswith('error: '), err
    return lines[0]


@pytest.mark.parametrize(
    'entry, says',
    [
        ('"offOrigin" value="0, 0, 1000"', 'no ray meets the volume'),
        ('"offDetector" value="0, 500"', 'no ray meets the volume'),
        ('"DSO" value="10"', 'source lies within the volume'),
        ('"DSD" value="1e5"', None),
    ],
)
def test_scans_that_see_no_volume(tmp_path, entry, says):
    name, line = (entry.split('"')[1], f'<string name={entry}/>' if 'off' in entry else f'<float name={entry}/>')
    old = f'<float name="{name}" value="{dict(DSO=100, DSD=150).get(name)}"/>'
    new = (old, line) if 'off' not in entry else ('<integer name="test_views"', line + '<integer name="test_views"')
    path, out = changed_scene(tmp_path, new), ('--out', tmp_path / 'v.nii')
    if says is None:  # the panel sees a part of it
        code, _, err = run(RECONSTRUCT, path, *out)
        assert code == 0 and 'may be truncated' in err
    else:
        assert says in refused(path, *out)


@pytest.mark.parametrize('factor, says', [(0, 'zero everywhere'), (-1, 'nowhere above zero')])
def test_projections_of_nothing(scene, dataset, tmp_path, factor, says):
    scan = dataset.train
    write_scan(tmp_path / 'scan.npy', replace(scan, projections=factor * scan.projections - 1e-3 * (factor < 0)), 'npy')
    assert says in refused(scene, '--projections', tmp_path / 'scan.npy', '--out', tmp_path / 'v.nii')
    assert not (tmp_path / 'v.nii').exists()


def test_truncated_measurements_are_told(scene, dataset, tmp_path):
    scan = dataset.train
    narrow = replace(scan.geometry, nDetector=(32, 10))
    write_scan(tmp_path / 'scan.npy', Scan(narrow, scan.projections[:, :, 15:25]), 'npy')
    code, _, err = run(RECONSTRUCT, scene, '--projections', tmp_path / 'scan.npy', '--out', tmp_path / 'v.nii')
    assert code == 0 and err.count('may be truncated') == 1, err


def test_too_many_views_and_too_little_memory(scene, fitted, tmp_path, monkeypatch):
    out = '--out', tmp_path / 'v.nii'
    assert 'at most 100000' in refused(scene, '--complete', fitted, '--views', 1_000_000, *out)
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 1e9)
    assert 'GiB of memory' in refused(scene, '--complete', fitted, '--views', 10_000_000, *out)
    size = 4 * (24**3 + 8 * 32 * 40)
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 3.8 * size)
    assert run(RECONSTRUCT, scene, '--algorithm', 'sart', '-D', 'niter=1', *out)[0] == 0
    for algorithm in 'cgls', 'asd-pocs':
        assert 'at least' in refused(scene, '--algorithm', algorithm, '-D', 'niter=1', *out, '--force')
