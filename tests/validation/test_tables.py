"""The paper's tables on objects of a few voxels: cells, interruptions, Markdown, and bad input in one line."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from unittest import mock

import mitsuba as mi
import numpy as np
import pytest

import lingo_mi as lm
from helpers.same import fits_alike
from helpers.script import run
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan, write_scan
from lingo_mi.files.volumes import write_volume
from lingo_mi.fitting.methods.cloud_method import CloudMethod
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.geometry import Grid
from lingo_mi.phantoms import make
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scene.simulate import choose_views
from lingo_mi.validation.tables import cells as tables
from lingo_mi.validation.tables.cells import SCALES, Cells, Fit, Scale, Volume, method_for
from lingo_mi.validation.tables.objects import available, load_object, scan_digest, scans_in
from lingo_mi.validation.tables.report import ABLATION, CONTROLS, groups, markdown, plan, results

TABLES = 'studies.tables'
TINY = Scale(16, 24, 200, (20,), ('foot',))
FAST = 'fast:iterations=15'
SHORT = 'r2:densify_from=5,densify_until=100,densify_every=6,densify_threshold=1e-6'


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(SCALES, 'small', TINY)
    monkeypatch.setattr(tables, 'SCANNED', 25)
    monkeypatch.setattr(tables, 'COMPLETED', 30)
    monkeypatch.setitem(tables.ALGORITHMS, 'sart', tables.SART(niter=2))
    monkeypatch.setitem(tables.ALGORITHMS, 'asd-pocs', tables.ASDPOCS(niter=1, tviter=2))


@pytest.fixture(scope='module')
def out(tmp_path_factory):
    """One folder of results for the tests that only add to it."""
    return tmp_path_factory.mktemp('tables')


def script(table, out, *args):
    return run(TABLES, table, '--objects', 'foot', '--out', out, *args)


def test_new_views(out):
    code, text, err = script('views', out, '--views', '4', '--iterations', '10', '20', '--methods', 'r2', FAST)
    assert code == 0, err
    rows = json.loads((out / 'views.json').read_text())
    assert [(r['views'], r['second'], r['object']) for r in rows] == [
        (4, n, name) for n in (10, 20) for name in ('foot', 'mean of 1')
    ]
    assert rows[0]['columns'][FAST] == rows[2]['columns'][FAST] != rows[0]['columns']['r2']
    assert rows[0]['columns']['r2'] == rows[1]['columns']['r2'] != rows[2]['columns']['r2']
    assert '3 of 3 cells' in text and (out / 'views.md').read_text() in text
    assert 'views' in json.loads((out / 'views.provenance.json').read_text())['command']
    assert Cells(out, TINY).get(Fit('foot', 4, 'r2', 10))['provenance']['versions']['mitsuba']
    row = next(line for line in text.splitlines() if line.startswith('| 4 | 10 | foot |'))
    assert f' {rows[0]["columns"]["r2"]["psnr_2d_r2"]:.2f} ' in row


def test_a_cell_that_exists_is_not_computed_again(out):
    arguments = 'views', out, '--views', '3', '--iterations', '5', '--methods', 'r2'
    assert script(*arguments)[0] == 0
    with mock.patch.object(Cells, 'compute', side_effect=AssertionError):
        code, text, _ = script(*arguments)
    assert code == 0 and '1 of 1 cells' in text


@pytest.mark.parametrize('content', [b'', b'{}', b'[]', b'{"psnr_2d_r2": 3', b'\xff'])
def test_a_damaged_cell_is_computed_again(out, content):
    arguments = 'views', out, '--views', '3', '--iterations', '5', '--methods', 'r2'
    assert script(*arguments)[0] == 0
    cells, cell = Cells(out, TINY), Fit('foot', 3, 'r2', 5)
    before = cells.get(cell)
    cells.path(cell).write_bytes(content)
    assert cells.get(cell) is None
    code, text, err = script(*arguments)
    assert code == 0 and '1 of 1 cells' in text, err
    assert numbers(cells.get(cell)) == pytest.approx(numbers(before))


def test_two_stages(out):
    code, text, err = script('ct', out, '--views', '4', '--iterations', '20', '--methods', 'r2')
    assert code == 0, err
    rows = {r['second']: r['columns'] for r in json.loads((out / 'ct.json').read_text()) if r['object'] == 'foot'}
    assert list(rows) == ['fdk', 'sart', 'asd-pocs', 'refined', 'voxelize']
    assert rows['voxelize']['none'] is None and '| voxelize | foot | – | – |' in text
    volumes = [rows[a][m]['psnr_3d_r2'] for a in ('fdk', 'sart', 'asd-pocs') for m in ('none', 'r2')]
    assert len(set(volumes)) == 6 and min(volumes) > 0
    # The algorithms give the same numbers on views rendered from the stored cloud.
    cells = Cells(out, TINY)
    fit = Fit('foot', 4, 'r2', 20)
    whole = cells._completed(fit)
    assert len(whole) == 30
    train = cells.dataset('foot').train
    np.testing.assert_array_equal(whole.projections[:4], train.projections[[0, 6, 12, 18]])
    volume = run_algorithm(whole, tables.FDK()).volume
    truth = make('foot', 16).data
    assert rows['fdk']['r2']['psnr_3d_r2'] == pytest.approx(
        tables.metrics.psnr_3d_r2(volume, truth), rel=fits_alike(1e-5)
    )
    measured = train.subset([0, 6, 12, 18])
    refined = run_algorithm(measured, tables.Refined(), completed=whole, sample=cells._cloud(fit).volume)
    actual = refined.volume
    assert rows['refined']['r2']['psnr_3d_r2'] == pytest.approx(
        tables.metrics.psnr_3d_r2(actual, truth), rel=fits_alike(1e-5)
    )
    assert (
        rows['refined']['none'] is None
        and groups('ct', [4], [20], ['3dgs'], ['refined'])[0].columns[1].cell('foot') is None
    )


def test_the_parts_of_lingo():
    """Each row has its parts and nothing else; the first and the last are the methods of the other tables."""
    grouped = groups('ablation', [25], [20], [])
    cells = {group.second: [column.cell('foot') for column in group.columns] for group in grouped}
    assert list(cells) == list(ABLATION) and all(volume == Volume(fit, 'asd-pocs') for fit, volume in cells.values())
    assert cells['- - -'][0] == Fit('foot', 25, 'r2', 20) and cells['+ + +'][0] == Fit('foot', 25, 'lingo', 20)
    base = method_for(cells['+ + +'][0], TINY)
    for parts, (fit, _) in cells.items():
        scale, start, voxels = (part == '+' for part in parts.split())
        of_start = dict(start='masks', V_S=20.0 * 16 / 256 if voxels else 1.0) if start else dict(start='fdk')
        changes = dict(loss_scale='dynamic' if scale else 'none', **of_start)
        assert method_for(fit, TINY).flat() == base.changed(**changes).flat()


def test_opacities_have_no_row_of_means(tmp_path):
    grouped = groups('ct', [4], [20], ['3dgs'])
    cells = mock.Mock(get=lambda cell: dict(psnr_3d_r2=30.0, ssim_3d_r2=0.9))
    rows = [(row['second'], row['object']) for row in results(grouped, ['foot'], [cells])]
    possible = 'fdk', 'sart', 'asd-pocs', 'sart-r2', 'asd-pocs-r2'
    assert rows == [(a, name) for a in possible for name in ('foot', 'mean of 1')] + [
        ('refined', 'foot'),
        ('finer', 'foot'),
        ('best', 'foot'),
        ('best', 'mean of 1'),
        ('voxelize', 'foot'),
    ]
    code, _, err = script('ct', tmp_path / 'a', '--methods', 'xgaussian', '--algorithms', 'refined')
    assert code == 2 and 'refined cannot make a volume of xgaussian' in err and err.count('\n') == 1
    assert not (tmp_path / 'a').exists()


def test_paper_beside_ours():
    grouped = groups('views', [5, 25], [5000, 30_000], ['r2', 'lingo', 'fast'])
    cells = mock.Mock(get=lambda cell: dict(psnr_2d_r2=30.0 + cell.views, ssim_2d_r2=0.9, ipsd=None))
    text = markdown('views', grouped, results(grouped, ['a', 'b'], [cells]))
    assert '| 25 | 30000 | paper | 46.09 | 0.9899 | 0.1129 | 47.04 | 0.9911 | 0.0233 | – | – | – |' in text
    assert '| 5 | 5000 | mean of 2 | 35.00 | 0.9000 | – |' in text
    grouped = groups('ct', [10], [30_000], ['lingo'])
    nothing = mock.Mock(get=lambda cell: None)
    text = markdown('ct', grouped, results(grouped, ['a'], [nothing]))
    assert '| 10 | asd-pocs | paper | 25.64 | 0.7215 | 28.90 | 0.8252 |' in text
    grouped = groups('ablation', [25], [30_000], [])
    assert '| 25 | + + + | paper | 0.47 | 47.04 | 0.9911 | 0.0289 | 32.91 | 0.8924 |' in markdown(
        'ablation', grouped, results(grouped, ['a'], [nothing])
    )


def test_the_order_of_cells():
    cells = plan(groups('ct', [25], [30], ['r2']), ['a', 'b'])
    assert [c.object if isinstance(c, Fit) else c.fit.object for c in cells] == ['a'] * 14 + ['b'] * 14
    fit, measured = Fit('a', 25, 'r2', 30), Fit('a', 25, 'none')
    assert cells[cells.index(fit) :][:8] == [fit, *(Volume(fit, a) for a in tables.ALGORITHMS if a != 'best')]
    alone = 'fdk', 'sart', 'asd-pocs', 'sart-r2', 'asd-pocs-r2', 'best'
    assert cells[:6] == [Volume(measured, a) for a in alone]  # the others need a cloud


def test_controls_have_as_many_iterations_as_asked_for():
    cells = [group.columns[0].cell('a') for group in groups('controls', [10], [30], [])]
    assert {tables.method_for(cell, tables.SCALES['small']).iterations for cell in cells} == {30}


# ---- interruptions ---------------------------------------------------------------------------------------------------


def numbers(table):
    return {
        k: table[k] for k in ('psnr_2d_r2', 'psnr_2d', 'ssim_2d_r2', 'psnr_3d_r2', 'ssim_3d_r2', 'ipsd', 'gaussians')
    }


def test_an_interrupted_fit_goes_on(tmp_path):
    fit, broken, whole = Fit('foot', 4, SHORT, 20), Cells(tmp_path / 'a', TINY), Cells(tmp_path / 'b', TINY)
    broken.dataset('foot')  # its scan shows its progress, too
    with mock.patch.object(tables.Progress, 'update', side_effect=_stop_at(13)), pytest.raises(KeyboardInterrupt):
        broken.compute(fit, 'fit')
    assert broken.get(fit) is None and broken.path(fit).with_name('checkpoint.npz').exists()
    with mock.patch.object(CloudMethod, 'starting_cloud', side_effect=AssertionError):
        resumed = broken.compute(fit, 'fit')
    assert numbers(resumed) == pytest.approx(numbers(whole.compute(fit, 'fit')))


@pytest.mark.thorough
@pytest.mark.parametrize('content', [None, b'', b'PK'])
def test_a_fit_without_its_checkpoint_is_fitted_again(tmp_path, content):
    """It is fitted again if a volume needs its cloud or a longer fit would go on from it; what is stored stays."""
    arguments = '--views', '4', '--methods', 'r2'
    assert script('views', tmp_path, *arguments, '--iterations', '10')[0] == 0
    cells, fit = Cells(tmp_path, TINY), Fit('foot', 4, 'r2', 10)
    before, saved = cells.get(fit), cells.path(fit).with_name('checkpoint.npz')

    def spoil():
        saved.unlink() if content is None else saved.write_bytes(content)

    spoil()
    assert script('views', tmp_path, *arguments, '--iterations', '10', '20')[0] == 0
    code, text, err = script('ct', tmp_path, *arguments, '--iterations', '10', '--algorithms', 'fdk', 'voxelize')
    assert code == 0 and '3 of 3 cells' in text and '--resume' not in err
    assert err.count('is missing or damaged, so foot, 4 views, r2 is fitted again\n') == 1
    assert numbers(cells.get(fit)) == pytest.approx(numbers(before))
    # Interrupted while it is fitted again, it goes on from there.
    spoil()
    cells.dataset('foot')  # its scan shows its progress, too
    with mock.patch.object(tables.Progress, 'update', side_effect=_stop_at(7)), pytest.raises(KeyboardInterrupt):
        cells.compute(fit, 'fit')
    assert tables._iterations(saved) == 7 and cells.get(fit) is not None
    cells.compute(Volume(fit, 'sart'), 'volume')
    assert tables._iterations(saved) == 10 and numbers(cells.get(fit)) == pytest.approx(numbers(before))


def test_a_longer_fit_goes_on_from_a_shorter_one(tmp_path, sums_in_order):
    short, fit = Fit('foot', 4, SHORT, 10), Fit('foot', 4, SHORT, 20)
    steps, whole = Cells(tmp_path / 'a', TINY), Cells(tmp_path / 'b', TINY)
    before = steps.compute(short, 'fit')
    with mock.patch.object(CloudMethod, 'starting_cloud', side_effect=AssertionError):
        after = steps.compute(fit, 'fit')
    assert (
        numbers(after) == pytest.approx(numbers(whole.compute(fit, 'fit'))) and after['gaussians'] > before['gaussians']
    )
    assert steps.compute(short, 'fit')['gaussians'] == before['gaussians']


def _stop_at(iteration):
    def update(done, **_):
        if done == iteration:
            raise KeyboardInterrupt

    return update


@pytest.mark.posix
@pytest.mark.thorough
def test_killed(tmp_path):
    """After `kill -9` in the middle of the second cell the first one stays, and the same command ends the table."""
    arguments = '--views', '4', '5', '--methods', 'r2', '--iterations', '20'
    code = (
        'import runpy, sys\nimport lingo_mi\nfrom lingo_mi.common.runtime import use_variant\n'
        f'use_variant({mi.variant()!r})\nfrom lingo_mi.validation.tables import cells as tables\n'
        'tables.SCALES["small"] = tables.Scale(16, 24, 200, (20,), ("foot",))\ntables.SCANNED = 25\n'
        'sys.argv = sys.argv[1:]\nrunpy.run_module(sys.argv[0], run_name="__main__")\n'
    )
    command = [TABLES, 'views', '--objects', 'foot', '--out', tmp_path, *arguments, '--variant', mi.variant()]
    cells = Cells(tmp_path, TINY)
    first, second = (cells.path(Fit('foot', n, 'r2', 20)) for n in (4, 5))
    process = subprocess.Popen(
        [sys.executable, '-c', code, *map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    begun = time.monotonic()
    while not second.parent.exists():
        assert process.poll() is None and time.monotonic() - begun < 300
        time.sleep(0.01)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL and first.exists() and not second.exists()
    before = first.stat().st_mtime_ns
    code, text, err = script('views', tmp_path, *arguments)
    assert code == 0 and '2 of 2 cells' in text and second.exists() and first.stat().st_mtime_ns == before, err


# ---- several seeds, scans of other people ----------------------------------------------------------------------------


def test_means_over_seeds_and_objects_with_their_errors():
    """A gain is a difference for each object. An object that is easy for every method does not widen its error."""
    grouped = groups('views', [5], [20], ['r2', 'lingo'])
    values = {
        ('a', 'r2'): (30.0, 32.0),
        ('a', 'lingo'): (32.0, 34.0),
        ('b', 'r2'): (40.0, 44.0),
        ('b', 'lingo'): (44.0, 46.0),
    }

    def cells(seed):
        return mock.Mock(
            get=lambda cell: dict(psnr_2d_r2=values[cell.object, cell.method][seed], ssim_2d_r2=0.9, ipsd=None)
        )

    rows = {row['object']: row['columns'] for row in results(grouped, ['a', 'b'], [cells(0), cells(1)])}
    shown = {name: (c['r2']['psnr_2d_r2'], c['lingo']['psnr_2d_r2']) for name, c in rows.items() if name != 'paper'}
    assert shown.pop('spread over seeds') == pytest.approx((np.sqrt((2 + 8) / 2), np.sqrt(2)))
    assert shown == {
        'a': (31, 33),
        'b': (42, 45),
        'mean of 2': (36.5, 39),
        'standard error': pytest.approx((5.5, 6)),
        'gain over r2': (0, 2.5),
        'its standard error': pytest.approx((0, 0.5)),
    }
    assert rows['mean of 2']['r2']['ipsd'] is None


def test_gains_of_rows_are_over_the_first():
    grouped = groups('controls', [25], [20], [])
    assert [group.second for group in grouped] == list(CONTROLS)
    for group in grouped:
        method_for(group.columns[0].cell('foot'), TINY)  # has these options
    quality = {'r2': 30.0, 'lingo': 31.0}

    def get(cell):
        if cell.method not in quality:
            return None
        return dict(
            psnr_2d_r2=quality[cell.method] + (cell.object == 'b'), ipsd=0.1, gaussians=9, psnr_3d_r2=30, ssim_3d_r2=1
        )

    rows = results(grouped, ['a', 'b'], [mock.Mock(get=get)])
    gains = [(row['second'], row['columns']['fit']['psnr_2d_r2']) for row in rows if row['object'] == 'gain over r2']
    assert gains == [('lingo', 1.0)]


@pytest.fixture(scope='module')
def theirs(tmp_path_factory):
    """A folder with a pickle like SAX-NeRF's and a folder like R2-Gaussian's."""
    folder = tmp_path_factory.mktemp('x3d')
    with mock.patch.object(tables, 'SCANNED', 6):
        data = Cells(folder, Scale(16, 24, 200, (20,), ('foot',))).dataset('foot')
    write_scan(folder / 'foot_50.pickle', data, 'naf')
    write_scan(folder / 'cone_foot', data, 'r2')
    (folder / 'notes.txt').write_text('mine')
    return folder


def test_scans_of_a_folder(theirs, tmp_path):
    """Fits to the files give the same numbers, beside the published ones of a scene of that name."""
    assert list(scans_in(theirs)) == ['cone_foot', 'foot']
    options = '--views', '4', '--iterations', '20', '--methods', 'r2:n_points=200', 'xgaussian', '--out', tmp_path
    code, text, err = run('x3d', theirs, '--tables', 'scenes', *options)
    assert code == 0 and '2 of 2 cells' in text and 'Scans as they are in their files' in text, err
    rows = {row['object']: row['columns'] for row in json.loads((tmp_path / 'scenes.json').read_text())}
    assert rows['foot']['R2-Gaussian'] == {'psnr_3d_r2': 32.0} and rows['cone_foot']['SAX-NeRF'] is None
    data = read_scan(theirs / 'foot_50.pickle')
    fit = lm.fit(choose_views(data, 4), lm.R2().changed(n_points=200, iterations=20), progress=False)
    assert rows['foot']['r2:n_points=200']['psnr_3d_r2'] == pytest.approx(
        fit.metrics()['psnr_3d_r2'], rel=fits_alike(1e-5)
    )
    assert rows['cone_foot']['r2:n_points=200']['psnr_3d_r2'] == pytest.approx(fit.metrics()['psnr_3d_r2'], abs=0.1)
    with mock.patch.object(Cells, 'compute', side_effect=AssertionError):
        assert run('x3d', theirs, '--tables', 'scenes', *options)[0] == 0
    code, text, err = run('x3d', theirs, '--tables', 'ct', *options, '--scenes', 'foot', '--algorithms', 'fdk')
    assert code == 0 and '| 4 | fdk | foot |' in text, err


def test_another_file_of_the_same_name_is_another_scan(theirs, tmp_path):
    (tmp_path / 'foot_50.pickle').write_bytes((theirs / 'foot_50.pickle').read_bytes())
    here, there = (Cells(tmp_path, replace(TINY, data=str(folder))) for folder in (tmp_path, theirs))
    fit = Fit('foot', 4, 'r2', 20)
    assert here.path(fit) == there.path(fit) != Cells(tmp_path, TINY).path(fit)
    (tmp_path / 'foot_50.pickle').write_bytes(b'other')
    scan_digest.cache_clear()
    assert here.path(fit) != there.path(fit)


def test_a_record_goes_on_without_the_files(tmp_path):
    record = tmp_path / 'kept' / 'cells.json'
    options = '--views', '4', '--methods', 'r2', '--iterations', '20', '--record', record
    assert script('views', tmp_path / 'a', *options, '--seeds', '0', '1')[0] == 0
    cells = json.loads(record.read_text())
    assert len(cells) == 2 and len(record.read_text().splitlines()) == 4
    assert all('history' not in cell and cell['psnr_3d_r2'] > 0 and 'date' in cell for cell in cells.values())
    with mock.patch.object(Cells, 'compute', side_effect=AssertionError):
        code, text, err = script('views', tmp_path / 'b', *options, '--seeds', '0', '1')
    assert code == 0 and '2 of 2 cells' in text and 'seeds 0, 1' in text, err
    code, text, err = script('ct', tmp_path / 'b', *options, '--algorithms', 'fdk')  # needs the cloud again
    assert code == 0 and '3 of 3 cells' in text, err
    record.write_text('[1]')
    code, _, err = script('views', tmp_path / 'c', *options)
    assert code == 2 and 'is not a record of cells' in err and err.count('\n') == 1


@pytest.mark.thorough
def test_the_first_views(tmp_path):
    first, even = Cells(tmp_path, replace(TINY, first=True)), Cells(tmp_path, TINY)
    fit = Fit('foot', 4, 'r2', 20)
    np.testing.assert_array_equal(first._measured(fit).train.projections, even.dataset('foot').train.projections[:4])
    assert first.path(fit) != even.path(fit)


# ---- objects and bad input -------------------------------------------------------------------------------------------


def test_volumes_are_averaged_down(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    data = rng.uniform(0, 1, (40, 30, 20)).astype(np.float32)
    write_volume(tmp_path / 'engine.nii.gz', data, Grid(data.shape, (1.0, 2.0, 3.0)))
    monkeypatch.setenv('LINGO_MI_DATA', str(tmp_path))
    lines = []
    assert available(['foot', 'engine', 'tooth'], lines.append) == ['foot', 'engine'] and 'tooth' in lines[0]
    small = load_object('engine', 20)
    assert small.data.shape == (20, 15, 10) and small.spacing == (2.0, 4.0, 6.0)
    np.testing.assert_allclose(small.data, data.reshape(20, 2, 15, 2, 10, 2).mean((1, 3, 5)), atol=1e-5)
    assert load_object('engine', 64).data.shape == data.shape


@pytest.mark.thorough
def test_objects_finer_than_the_voxels(tmp_path):
    """The scanned object has twice the voxels; the reconstruction and its truth have the voxels of the scale."""
    scale = replace(TINY, finer=2)
    coarse, fine = Cells(tmp_path, TINY), Cells(tmp_path, scale)
    data, usual, scanned = fine.dataset('foot'), coarse.dataset('foot'), make('foot', 32)
    geometry = data.train.geometry
    assert (
        (geometry.grid.shape, geometry.grid.spacing)
        == (usual.train.geometry.grid.shape, usual.train.geometry.grid.spacing)
        == ((16,) * 3, (16.0,) * 3)
    )
    np.testing.assert_allclose(data.volume, scanned.data.reshape(16, 2, 16, 2, 16, 2).mean((1, 3, 5)), atol=1e-5)
    expected = tables.scan(scanned, 25, 0, pixels=24)
    np.testing.assert_array_equal(data.train.projections, expected.train.projections)
    np.testing.assert_array_equal(data.test.projections, expected.test.projections)
    assert coarse.path(Fit('foot', 4, 'r2')) != fine.path(Fit('foot', 4, 'r2'))
    code, text, err = script(
        'ct',
        tmp_path,
        '--finer',
        '2',
        '--views',
        '4',
        '--methods',
        'r2:n_points=50',
        '--iterations',
        '5',
        '--algorithms',
        'fdk',
        'finer',
    )
    assert code == 0 and '(scanned on 2 times as many)' in text and 'r2:n_points=50 PSNR' in text, err
    assert '| 4 | finer | foot | – | – |' in text


@pytest.mark.thorough
def test_scans_with_noise(tmp_path):
    """The fitted views are counted, on a scale of the density that lets so many photons through; the held-out ones are not."""
    scale = replace(TINY, photons=1e4, electronic_noise=10.0, longest=1.0)
    clean, noisy = Cells(tmp_path, TINY).dataset('foot'), Cells(tmp_path, scale).dataset('foot')
    np.testing.assert_array_equal(noisy.test.projections, clean.test.projections)
    np.testing.assert_array_equal(noisy.volume, clean.volume)
    unit = 1 / clean.train.projections.max()
    p = clean.train.projections * unit
    sigma = np.sqrt(np.exp(p) / 1e4 + (10 / 1e4 * np.exp(p)) ** 2)
    standard = (noisy.train.projections * unit - p) / sigma
    assert abs(standard.std() - 1) < 0.03 and abs(standard.mean()) < 0.03
    assert Cells(tmp_path, scale).path(Fit('foot', 4, 'r2')) != Cells(tmp_path, TINY).path(Fit('foot', 4, 'r2'))
    options = '--photons', '1e4', '--electronic-noise', '10', '--longest', '1'
    code, text, err = script('ct', tmp_path, *options, '--views', '5', '--algorithms', 'best', '--methods', 'r2')
    assert (
        code == 0 and '10000 photons a pixel in the open beam, electronic noise of 10, line integrals up to 1' in text
    ), err
    assert '| 5 | best | foot |' in text and '1 of 1 cells' in text


def test_without_any_object_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setenv('LINGO_MI_DATA', '')
    (tmp_path / 'views.md').write_text('kept')
    code, _, err = run(TABLES, 'views', '--objects', 'engine', '--out', tmp_path)
    assert code == 2 and err.startswith('error: no object is left') and err.count('\n') == 1
    assert [p.name for p in tmp_path.iterdir()] == ['views.md'] and (tmp_path / 'views.md').read_text() == 'kept'


def test_methods():
    assert method_for(Fit('foot', 5, 'r2', 7), TINY).iterations == 7
    assert method_for(Fit('foot', 5, 'fast'), TINY).iterations == Fast.iterations
    method = method_for(Fit('foot', 5, 'lingo:V_S=1,n_points=70'), TINY)
    assert (
        method.start.V_S,
        method.start.n_points,
        method.loss.loss_scale,
        method_for(Fit('foot', 5, 'r2'), TINY).start.n_points,
    ) == (1, 70, 'dynamic', 200)
    with pytest.raises(InputError, match='there is no method'):
        method_for(Fit('foot', 5, '3d'), TINY)


@pytest.mark.parametrize(
    'args, message',
    [
        (['views', '--objects', 'hand'], "'hand' is unknown"),
        (['views', '--views', '26'], '25'),
        (['views', '--views', '0'], '25'),
        (['ct', '--iterations', '0'], 'at least 1'),
        (['views', '--seeds', '-1'], '--seeds must be a whole number from 0 on'),
        (['figures'], 'invalid choice'),
        (['views', '--methods', 'nerf'], 'there is no method'),
        (['ct', '--methods', 'r2:V=1'], 'unknown setting'),
        (['ct', '--finer', '0'], 'at least 1'),
        (['ct', '--photons', '-1'], 'photons'),
        (['ct', '--electronic-noise', '10'], 'needs photons'),
        (['ct', '--photons', '1000', '--longest', 'nan'], '--longest must be above 0'),
        (['scenes'], 'invalid choice'),
        (['controls', '--methods', 'r2'], '--methods has no effect on controls'),
    ],
)
def test_bad_input(args, message, tmp_path):
    code, _, err = run(TABLES, *args, '--out', tmp_path / 'a')
    printed = err if isinstance(code, int) else code
    assert code == 2 and message in printed and printed.count('\n') == 1 and printed.startswith('error: ')
    assert not (tmp_path / 'a').exists()


@pytest.mark.parametrize(
    'args, message',
    [
        (['nowhere'], 'nowhere: is not a folder'),
        (['empty'], 'holds neither pickles'),
        (['.', '--tables', 'figures'], 'invalid choice'),
        (['.', '--scenes', 'hand'], "there is no scan 'hand'; it has cone_foot, foot"),
    ],
)
def test_bad_input_of_x3d(args, message, theirs, tmp_path, monkeypatch):
    monkeypatch.chdir(theirs)
    (tmp_path / 'empty').mkdir()
    folder = tmp_path / 'empty' if args[0] == 'empty' else args[0]
    code, _, err = run('x3d', folder, *args[1:], '--out', tmp_path / 'a')
    assert code == 2 and message in err and err.count('\n') == 1 and not (tmp_path / 'a').exists()


def test_a_file_in_the_place_of_the_folder(tmp_path):
    (tmp_path / 'a').touch()
    code, _, err = run(TABLES, 'views', '--objects', 'foot', '--out', tmp_path / 'a')
    assert code == 2 and 'a: is a file' in err and err.count('\n') == 1


def test_a_cell_that_fails_does_not_stop_the_others(tmp_path):
    compute = Cells.compute

    def failing(self, cell, label):
        if isinstance(cell, Fit) and cell.method == 'lingo':
            raise InputError('no')
        return compute(self, cell, label)

    with mock.patch.object(Cells, 'compute', failing):
        code, text, err = script('views', tmp_path, '--views', '4', '--iterations', '5', '--methods', 'lingo', 'r2')
    assert code == 2 and '1 of 2 cells' in text and err.splitlines()[-1].startswith('error: 1 of 2 cells failed')
