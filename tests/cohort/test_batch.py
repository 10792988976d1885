"""A cohort in this process: the list, what is stored, interruptions, failures."""

import csv
import json
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

import lingo_mi as lm
from helpers.cohorts import BATCH, events, results
from helpers.script import FIT, SCENE, run
from lingo_mi.cohort import work
from lingo_mi.cohort.listing import BadList, read_list
from lingo_mi.cohort.row import SCAN, Row, stored
from lingo_mi.cohort.table import Table
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import write_scan
from lingo_mi.files.volumes import write_volume
from lingo_mi.geometry.grid import Grid
from lingo_mi.storage.output_folder import CHECKPOINT, METRICS

SHORT = 'fast:iterations=20,n_points=100'


@pytest.fixture
def home(tmp_path):
    """A folder with a scene, tiny.xml, and a list of three scans of it."""
    (tmp_path / 'tiny.xml').write_text(SCENE)
    (tmp_path / 'list.csv').write_text('name,geometry,views\na,tiny.xml,5\nb,tiny.xml,6\nc,tiny.xml,\n')
    return tmp_path


def batch(home, *args):
    return run(BATCH, home / 'list.csv', '--method', SHORT, '--out', home / 'out', *args)


def test_a_cohort(home):
    code, text, err = batch(home)
    assert code == 0, err
    rows = results(home)
    assert [row['status'] for row in rows.values()] == ['done'] * 3 and [r['views'] for r in rows.values()] == [
        '5',
        '6',
        '8',
    ]
    for name, row in rows.items():
        assert row['iterations'] == '20' and row['seed'] == '0' and name in text
        stored_numbers = json.loads((home / 'out' / name / METRICS).read_text())
        assert float(row['psnr_2d']) == stored_numbers['psnr_2d'] and float(row['psnr_3d']) == stored_numbers['psnr_3d']
    # `lingo-mi fit` gives the same numbers.
    code, _, err = run(
        FIT, home / 'tiny.xml', '--views', 5, '--iterations', 20, '-D', 'n_points=100', '--out', home / 'fit'
    )
    assert code == 0, err
    assert json.loads((home / 'fit' / METRICS).read_text())['psnr_2d'] == pytest.approx(
        float(rows['a']['psnr_2d']), rel=1e-4
    )
    # Done is not done again; a new row is.
    before = {name: (home / 'out' / name / METRICS).stat().st_mtime_ns for name in rows}
    with open(home / 'list.csv', 'a') as file:
        file.write('d,tiny.xml,4\n')
    code, text, err = batch(home)
    assert code == 0 and '3 of 4 scans are done already' in text, err
    assert {name: (home / 'out' / name / METRICS).stat().st_mtime_ns for name in before} == before
    assert results(home)['d']['status'] == 'done' and len(events(home, 'done')) == 4
    # With other options, what is there is not the answer, and stays.
    code, _, err = run(BATCH, home / 'list.csv', '--method', 'fast:iterations=21,n_points=100', '--out', home / 'out')
    assert code == 2 and err.count('holds a result of other values of method, settings') == 4 and err.count('\n') == 5
    assert {name: (home / 'out' / name / METRICS).stat().st_mtime_ns for name in before} == before


def test_parquet(home):
    parquet = pytest.importorskip('pyarrow.parquet')
    (home / 'list.csv').write_text('geometry,lambda_tv\ntiny.xml,0.1\n')
    assert batch(home)[0] == 0
    table = parquet.read_table(home / 'out' / 'results.parquet').to_pylist()
    assert table[0]['psnr_2d'] == float(results(home)['tiny']['psnr_2d']) and table[0]['lambda_tv'] == '0.1'
    assert table[0]['error'] is None and table[0]['views'] == 8


def test_columns_of_text_and_numbers(tmp_path):
    """A column of the Parquet file has one kind of value, even if a failed row has text and the others have numbers."""
    parquet = pytest.importorskip('pyarrow.parquet')
    rows = [Row('a', 2, '.'), Row('b', 3, '.'), Row('c', 4, '.', settings=dict(iterations='900'))]
    table = Table(tmp_path, rows)
    table.done('a', dict(iterations=2000, views=5, psnr_2d=40.5))
    table.done('b', dict(iterations=1400, views=6, psnr_2d=41))
    table.state('c', 'failed', 'why')
    table.finish()
    read_rows = parquet.read_table(tmp_path / 'results.parquet').to_pylist()
    assert [row['iterations'] for row in read_rows] == ['2000', '1400', '900']
    assert [row['psnr_2d'] for row in read_rows] == [40.5, 41, None]


@pytest.mark.parametrize('name', ['results.parquet', 'batch.log'])
def test_files_of_a_stranger_are_left_alone(home, name):
    (home / 'out').mkdir()
    (home / 'out' / name).write_text('mine')
    code, _, err = batch(home)
    assert code == 2 and f'{name}: does not belong to a batch' in err and err.count('\n') == 1
    assert (home / 'out' / name).read_text() == 'mine' and len([*(home / 'out').iterdir()]) <= 2


def test_another_scene_of_the_same_name_is_another_request(home):
    (home / 'list.csv').write_text('name,geometry,views\na,tiny.xml,5\n')
    assert batch(home)[0] == 0
    (home / 'tiny.xml').write_text(SCENE.replace('</scene>', '\n</scene>'))
    code, _, err = batch(home)
    assert code == 2 and 'holds a result of other values of content of the geometry' in err


def test_projections_and_volumes(home):
    geometry = lm.Geometry.cone(
        DSO=100, DSD=150, nDetector=(20, 24), dDetector=1.8, nVoxel=16, dVoxel=1.5, angles=np.linspace(0, 3, 7)
    )
    volume = lm.phantom('foot', size=16).data
    write_scan(home / 'one.npy', lm.simulate(volume, geometry, progress=False).train, 'npy')
    (home / 'deep').mkdir()
    (home / 'one.yml').rename(home / 'deep' / 'two.yml')
    write_volume(home / 'ct.nii.gz', volume, Grid(volume.shape, 1.5))
    (home / 'list.csv').write_text('file,geometry,views\none.npy,deep/two.yml,5\nct.nii.gz,tiny.xml,6\n')
    code, _, err = batch(home)
    assert code == 0, err
    rows = results(home)
    assert rows['one']['psnr_3d'] == '' and float(rows['one']['psnr_2d']) > 10  # 2 of 7 views are held out
    assert float(rows['ct']['psnr_3d']) > 10 and lm.load_fit(home / 'out' / 'ct').volume().shape == (16,) * 3


def test_another_scan_of_the_same_name_is_another_request(home):
    """This holds also if the file has the same size, and if only a file beside it has changed."""
    geometry = lm.Geometry.cone(
        DSO=100, DSD=150, nDetector=(20, 24), dDetector=1.8, nVoxel=16, dVoxel=1.5, angles=np.linspace(0, 3, 7)
    )
    scan = lm.simulate(lm.phantom('foot', size=16), geometry, progress=False).train
    (home / 'list.csv').write_text('file\none.npy\n')
    write_scan(home / 'one.npy', scan, 'npy')
    assert batch(home)[0] == 0 and '1 of 1 scans are done already' in batch(home)[1]
    text = (home / 'one.yml').read_text()
    write_scan(home / 'one.npy', replace(scan, projections=2 * scan.projections), 'npy')
    code, _, err = batch(home)
    assert code == 2 and 'holds a result of other values of content of the scan' in err
    write_scan(home / 'one.npy', scan, 'npy')
    assert batch(home)[0] == 0
    (home / 'one.yml').write_text(text.replace('DSO: 100', 'DSO: 99'))
    assert 'content of the scan' in batch(home)[2]


def test_the_geometry_of_projections_in_chunks_is_part_of_the_request(tmp_path):
    pytest.importorskip('zarr')
    geometry = lm.Geometry.parallel(nDetector=4, dDetector=1, nVoxel=4, dVoxel=1, angles=[0.0, 1.5])
    write_scan(tmp_path / 'one.zarr', lm.Scan(geometry, np.ones((2, 4, 4), np.float32)), 'zarr')
    row = Row('one', 1, str(tmp_path), 'one.zarr')
    before, file = row.request(), tmp_path / 'one.yml'
    file.write_text(file.read_text().replace('dVoxel: [1.0', 'dVoxel: [1.5'))
    assert {name for name in before if row.request()[name] != before[name]} == {SCAN}


def test_the_table_has_the_steps_that_were_made(home):
    table = Table(home / 'out', [Row('a', 2, str(home), geometry='tiny.xml', settings=dict(iterations='1400'))])
    table.done('a', dict(iterations=350, views=5, psnr_3d=30.0))
    assert table._rows['a']['iterations'] == 350 and table._rows['a']['status'] == 'done'


def test_failures_are_tried_once_more(home):
    np.save(home / 'bad.npy', np.full((2, 4, 4), np.nan))
    (home / 'bad.yml').write_text('DSO: 100\nDSD: 150\nnDetector: 4\ndDetector: 1\nnVoxel: 4\ndVoxel: 1\n')
    (home / 'list.csv').write_text('file,geometry\nbad.npy,bad.yml\n,tiny.xml\n')
    code, _, err = batch(home)
    assert code == 2 and err.splitlines()[-1] == 'error: 1 of 2 scans failed twice; the same command tries them again'
    assert [line.split(':')[0] for line in events(home)[1:]] == [
        'began bad', 'failed bad', 'began tiny', 'done tiny', 'began bad', 'failed bad'
    ]  # fmt: skip
    rows = results(home)
    assert (rows['bad']['status'], rows['tiny']['status']) == ('failed', 'done') and 'bad.npy' in rows['bad']['error']
    assert f'failed: bad: {rows["bad"]["error"]}' in err and not (home / 'out' / 'bad').exists()
    # Mended, the second attempt of the same command does it.
    np.save(home / 'bad.npy', np.ones((2, 4, 4)))
    first, fit = [], work.fit

    def once(*args, **kwargs):
        if not first:
            first.append(True)
            raise RuntimeError('a library fell over\nbadly')
        return fit(*args, **kwargs)

    with mock.patch.object(work, 'fit', once):
        code, _, err = batch(home)
    assert code == 0 and 'Traceback' in err and results(home)['bad']['status'] == 'done'
    assert 'failed bad: RuntimeError: a library fell over badly' in events(home)


def test_ctrl_c_and_on(home):
    seen = []

    def stop_at(self, done, **_):
        seen.append(done)
        if self.description.endswith('b') and done == 13:
            raise KeyboardInterrupt

    with mock.patch('lingo_mi.jobs.in_process.Progress.update', stop_at):
        code, _, err = batch(home)
    assert code == 130 and err.splitlines()[-1] == 'interrupted: the same command goes on from here'
    assert [row['status'] for row in results(home).values()] == ['done', 'interrupted', 'waiting']
    assert (home / 'out' / 'b' / CHECKPOINT).exists() and not (home / 'out' / 'b' / METRICS).exists()
    code, _, err = batch(home)
    assert code == 0 and events(home, 'resumed') == ['resumed b: 14'] and len(events(home, 'done')) == 3, err
    broken = results(home)['b']
    (home / 'out').rename(home / 'before')
    batch(home)
    assert float(results(home)['b']['psnr_2d']) == pytest.approx(float(broken['psnr_2d']), rel=1e-4)


def test_another_batch_in_the_folder(home):
    with lm_locked(home / 'out'):
        code, _, err = batch(home)
    assert code == 2 and 'is writing there' in err and err.count('\n') == 1


def lm_locked(folder):
    from lingo_mi.storage.folder_lock import locked

    return locked(folder)


@pytest.mark.parametrize('content', [
    '\ufeffname,geometry\na,tiny.xml\n'.encode(), b'name;geometry\r\n\r\na;tiny.xml\r\n', b'name\tgeometry\na\ttiny.xml',
    b'\n\n"name", geometry\n" a ","tiny.xml"\n\n', 'name,geometry\nMüller 1,tiny.xml\n'.encode(),
])  # fmt: skip
def test_lists_that_spreadsheets_write(home, content):
    (home / 'list.csv').write_bytes(content)
    (row,) = read_list(home / 'list.csv')
    assert row.name in ('a', 'Müller 1') and row.geometry == 'tiny.xml'


@pytest.mark.parametrize('content, message', [
    (b',,\n,\n', 'is empty'),
    (b'', 'is empty'), (b'\xef\xbb\xbf\n \n', 'is empty'), (b'file\n', 'no scan below'), (b'name,views\na,3\n', 'no column file'),
    (b'file,file\na,b\n', "2 columns 'file'"), (b'file,,views\na,b,3\n', 'column 2 has no name'),
    ('file\nä\n'.encode('latin-1'), 'line 2: is not UTF-8'), ('file\na\n'.encode('utf-16'), 'UTF-16'),
    (b'file\n"a\n', 'not CSV'), (b'file\na\0b\n', ''), (b'\x00\x01\x02', ''),
])  # fmt: skip
@pytest.mark.posix
def test_files_that_are_no_list(home, content, message):
    (home / 'list.csv').write_bytes(content)
    code, _, err = batch(home)
    assert code == 2 and message in err and err.startswith('error: ') and 'Traceback' not in err
    assert not (home / 'out').exists()


ROWS = {
    ',nothing.xml': 'there is no such scene', ',nothing': 'must be a geometry file', 'list.csv,': 'not a known scan format',
    'no.pickle,': 'no such file', 'out_of_place,': 'has neither', '/dev/zero,tiny.xml': 'device', ',one.yml': 'has no file',
    'no\x07.pickle,': 'is not a name of a folder', '../../etc/passwd.npy,': 'no such file', ',': '', 'x,y,z': 'has 3 cells',
    'a': 'has 1 cell',
}  # fmt: skip


def test_every_bad_row_has_its_line(home):
    rows = [row for row in ROWS if row != ',']  # a row of empty cells is blank
    (home / 'out_of_place').mkdir()
    (home / 'list.csv').write_text('file,geometry\n,tiny.xml\n' + '\n'.join(rows) + '\n')
    code, _, err = batch(home)
    lines = err.splitlines()
    assert code == 2 and len(lines) == len(rows) + 1 and not (home / 'out').exists()
    for number, (row, line) in enumerate(zip(rows, lines), 3):
        assert f'list.csv, line {number}' in line and ROWS[row] in line, line
        assert len(line) < 310 and line.isprintable()
    assert lines[-1].endswith(f'{len(rows)} of {len(rows) + 1} rows cannot be used, so nothing was begun')


@pytest.mark.parametrize('name', [
    '..', '.', '.hidden', 'a/b', 'a\\b', '/tmp/x', '-rf', 'a ', 'con', 'LPT1.txt', 'results.csv', 'Batch.LOG', 'x' * 101, 'a:b',
    'a*', 'a\x07b', 'ä' * 60, 'a.',
])  # fmt: skip
def test_names_that_are_no_folder(home, name):
    with open(home / 'list.csv', 'w', newline='') as file:
        csv.writer(file).writerows([['name', 'geometry'], ['x ' + name if name == 'a ' else name, 'tiny.xml']])
    if name == 'a ':  # spaces around a cell are not part of it
        assert read_list(home / 'list.csv')[0].name == 'x a'
        return
    with pytest.raises(BadList) as caught:
        read_list(home / 'list.csv')
    assert 'name' in caught.value.lines[0] and len(caught.value.lines) == 1


def test_names_that_collide(home):
    """Names collide even if only some file systems take them for the same."""
    (home / 'list.csv').write_text(
        'name,geometry\nFoot,tiny.xml\nfoot,tiny.xml\nüber,tiny.xml\nu\u0308ber,tiny.xml\n,tiny.xml\n,tiny.xml\n'
    )
    with pytest.raises(BadList) as caught:
        read_list(home / 'list.csv')
    assert [line.rpartition('line ')[2].split()[0] for line in caught.value.lines] == ['2', '4', '6']


@pytest.mark.parametrize('cells, message', [
    ('views,0', 'views must be'), ('views,1e3', 'views must be'), ('seed,-1', 'seed must be'), ('mu_water,-1', 'mu_water'),
    ('method,nerf', 'there is no method'), ('method,fast:x=1', 'unknown setting'), ('iterations,0', 'iterations must'),
    ('iteration,5', 'did you mean iterations'), ('lambda_tv,nan', 'lambda_tv'), ('seed,99999999999999999999', 'seed must be'),
])  # fmt: skip
def test_bad_options(home, cells, message):
    column, value = cells.split(',')
    (home / 'list.csv').write_text(f'geometry,{column}\ntiny.xml,{value}\n')
    with pytest.raises(BadList) as caught:
        read_list(home / 'list.csv')
    assert message in caught.value.lines[0]


def test_methods_side_by_side(home):
    """A column may mean nothing to the method of a row, and is empty there."""
    lines = 'fast,,5,\nnaf,,4,8\nr2,0.2,6,\nfast:start=masks,,7,\n'.splitlines()
    rows = [f'{i},tiny.xml,{line}' for i, line in enumerate(lines)]
    (home / 'list.csv').write_text('name,geometry,method,lambda_tv,iterations,field_levels\n' + '\n'.join(rows))
    methods = [row.fit_method() for row in read_list(home / 'list.csv')]
    assert [(m.name, m.iterations) for m in methods] == [('fast', 5), ('naf', 4), ('r2', 6), ('fast', 7)]
    assert methods[1].field.field_levels == 8 and methods[2].loss.lambda_tv == 0.2 and methods[3].start.name == 'masks'
    (home / 'list.csv').write_text(
        'name,geometry,method,start,density,fit_air\na,tiny.xml,fast,masks,r2,\nb,tiny.xml,naf,,,view\n'
    )
    with pytest.raises(BadList) as caught:
        read_list(home / 'list.csv')
    (line,) = caught.value.lines
    assert 'line 3' in line and "'fit_air' is neither a column" in line and "nor an option of 'naf'" in line


def test_parameters_of_a_scene_go_before_settings(home):
    (home / 'tiny.xml').write_text(
        SCENE.replace('name="views" value="8"', 'name="batch" value="8"').replace('$views', '$batch')
    )
    (home / 'list.csv').write_text('geometry,batch,lambda_tv\ntiny.xml,5,0.1\n')
    (row,) = read_list(home / 'list.csv')
    assert (row.parameters, row.settings) == (dict(batch='5'), dict(lambda_tv='0.1'))
    assert len(work.read_row(row).train) == 5


def test_folders_that_are_not_ours(home):
    out = home / 'out'
    for name in 'abc':
        (out / name).mkdir(parents=True)
    (out / 'a' / 'notes.txt').write_text('mine')
    (out / 'b').rmdir()
    (out / 'b').symlink_to(home)
    (out / 'c' / METRICS).write_text('{}')
    code, _, err = batch(home)
    assert code == 2 and err.count('\n') == 4 and 'so nothing was begun' in err, err
    assert (out / 'a' / 'notes.txt').read_text() == 'mine' and (out / 'c' / METRICS).read_text() == '{}'
    (out / 'a' / 'notes.txt').unlink()
    (out / 'b').unlink()
    (out / 'c' / METRICS).unlink()
    (out / 'results.csv').write_text('mine')
    code, _, err = batch(home)
    assert code == 2 and 'results.csv: is not a table of a batch' in err and (out / 'results.csv').read_text() == 'mine'


def test_a_damaged_result(home):
    assert batch(home)[0] == 0
    row = read_list(home / 'list.csv', SHORT)[0]
    assert stored(home / 'out', row)['views'] == 5
    metrics = home / 'out' / 'a' / METRICS
    values = json.loads(metrics.read_text())
    del values['request']['settings']
    metrics.write_text(json.dumps(values))
    with pytest.raises(InputError, match='is damaged'):
        stored(home / 'out', row)
    (home / 'out' / 'a' / 'gaussians.ply').unlink()
    values['request']['settings'] = {}
    metrics.write_text(json.dumps(values))
    with pytest.raises(InputError, match='holds a result of other values of'):
        stored(home / 'out', row)
    values['request']['settings'] = row.request()['settings']
    metrics.write_text(json.dumps(values))
    with pytest.raises(InputError, match=r'gaussians\.ply: is missing'):
        stored(home / 'out', row)
    (home / 'out' / 'a' / METRICS).write_text('{')
    with pytest.raises(InputError, match='is damaged'):
        stored(home / 'out', row)


@pytest.mark.parametrize('arguments, message', [
    (('--cluster', 'local:0'), 'write local:N'), (('--cluster', 'local'), 'write local:N'), (('--threads', '2'), 'goes with'),
    (('--cluster', 'no.json'), 'no such file'), (('--cluster', 'nothing://x:1'), 'no scheduler'),
    (('--method', 'x'), 'there is no method'),
])  # fmt: skip
def test_bad_arguments(home, arguments, message):
    code, _, err = batch(home, *arguments)
    assert code == 2 and message in err and err.count('\n') == 1, err
    assert not (home / 'out').exists()


def test_files_that_a_geometry_names_belong_to_the_request(home):
    """A mask and poses in their own files belong to it; files beside the scan that are not read do not."""
    geometry = lm.Geometry.cone(
        DSO=100, DSD=150, nDetector=(20, 24), dDetector=1.8, nVoxel=16, dVoxel=1.5, angles=np.linspace(0, 3, 7)
    )
    scan = lm.simulate(lm.phantom('foot', size=16), geometry, progress=False).train
    valid = np.ones(scan.projections.shape, bool)
    valid[:, :2] = False
    write_scan(home / 'one.npy', replace(scan, valid=valid), 'npy')
    row = Row('one', 2, str(home), file='one.npy')
    of_scene = Row('ct', 3, str(home), geometry='tiny.xml')
    asked = row.request(), of_scene.request()
    (home / 'one.png').write_text('x')
    (home / 'one.calibrated.npy').write_text('x')
    assert asked == (row.request(), of_scene.request())
    (home / 'named').mkdir()
    (home / 'one.yml').rename(home / 'named' / 'two.yml')
    (home / 'one.valid.npy').rename(home / 'named' / 'one.valid.npy')
    row = Row('one', 2, str(home), file='one.npy', geometry='named/two.yml')
    asked = row.request()
    np.save(home / 'named' / 'one.valid.npy', ~valid)
    assert row.request() != asked
    (home / 'tiny.xml').write_text(
        SCENE.replace('"phantom" value="foot"', '"filename" value="$ct"').replace(
            '<scene version="3.0.0">', '<scene version="3.0.0"><default name="ct" value="ct.npy"/>'
        )
    )
    np.save(home / 'ct.npy', np.ones((4, 4, 4), np.float32))
    asked = of_scene.request()
    np.save(home / 'ct.npy', np.zeros((4, 4, 4), np.float32))
    assert of_scene.request() != asked
