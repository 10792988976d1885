"""Results side by side: what the page holds, and what cannot be compared."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import lingo_mi as lm
from helpers.browser import browser, opened, readout
from helpers.script import run
from lingo_mi.common.errors import InputError
from lingo_mi.files.images import write_exr
from lingo_mi.files.slabs import plan_and_error_map
from lingo_mi.files.volumes import write_volume
from lingo_mi.fitting.loop import run as run_fit
from lingo_mi.geometry import Grid
from lingo_mi.results.compare import VolumeFile, compare_page, load_result
from lingo_mi.scan import values_digest

COMPARE = 'compare'
SHAPE = 12, 10, 8


@pytest.fixture(scope='module')
def checkpoints(tmp_path_factory):
    """Checkpoints of two fits that differ in their seed and a setting, each in a folder of its own."""
    geometry = lm.Geometry.cone(
        DSO=100, DSD=150, nDetector=(6, 7), dDetector=(0.5, 2.0), nVoxel=SHAPE, dVoxel=2, angles=lm.circular(4)
    )
    folders, scan = [tmp_path_factory.mktemp('fit') for _ in range(2)], lm.Scan(geometry, np.ones((4, 6, 7)))
    for seed, folder in enumerate(folders):
        run_fit(
            scan, lm.R2().changed(iterations=5, n_points=40, lambda_tv=0.1 * seed), seed, path=folder / 'checkpoint.npz'
        )
    return folders


@pytest.fixture
def result(checkpoints):
    """A folder as `fit` writes it, but for what a comparison does not read."""

    def write(folder, seed, **numbers):
        rng = np.random.default_rng(seed)
        (folder / 'views').mkdir(parents=True)
        shutil.copy(checkpoints[seed] / 'checkpoint.npz', folder)
        for i in range(3):
            write_exr(folder / 'views' / f'000{i}.exr', rng.random((6, 7)).astype(np.float32))
        metrics = dict(
            psnr_3d=30.0 + seed, psnr_3d_r2=31.0, seconds_fit=10.0 + seed, gaussians=100 * (seed + 1),
            test_angles=[0.0, 20.0, 10.0], command=f'lingo-mi fit {seed}', iterations=5,
        )  # fmt: skip
        (folder / 'metrics.json').write_text(json.dumps(metrics | numbers))
        return folder

    return write


@pytest.fixture
def pair(result, tmp_path):
    return result(tmp_path / 'a', 0), result(tmp_path / 'b', 1)


def cells(page, name):
    row = re.search(rf'<tr><th scope="row">{re.escape(name)}</th>(.*?)</tr>', page)[1]
    return re.findall('<td class="value">(.*?)</td>', row)


def test_places_in_views_are_mm(result, tmp_path):
    results = [load_result(result(tmp_path / name, i, parameters=100 * i + 5)) for i, name in enumerate('ab')]
    page = compare_page(results)
    assert '"pixel":[0.5,2.0]' in page and '"unit":"mm"' in page and '★ 105' not in page and '★ 5' not in page


def test_a_fit_that_was_not_saved(pair):
    """It has the numbers of a saved one."""
    saved = lm.load_fit(pair[0])
    page = compare_page([('a', lm.Fit(saved.checkpoint, saved.model)), load_result(pair[1])])
    assert cells(page, 'Gaussians') == ['40', '200  (+160)'] and cells(page, 'lambda_tv') == ['0', '0.1']
    assert cells(page, 'Method')[0] == 'r2' and 'id="array-views0"' not in page


def test_a_map_of_errors_is_that_of_its_volume(tmp_path):
    """A map of another volume that was there before is not shown."""
    volume, plan = np.random.default_rng(0).random(SHAPE).astype(np.float32), tmp_path / 'v-plan.json'
    for name in ('v', 'v-error'):
        write_volume(tmp_path / f'{name}.nii.gz', volume, Grid(SHAPE, 2.0), 'density per mm')
    plan.write_text(json.dumps(dict(volume=values_digest(volume))))
    assert VolumeFile.read(tmp_path / 'v.nii.gz').error_map is not None
    plan.write_text(json.dumps(dict(volume=values_digest(2 * volume))))
    assert VolumeFile.read(tmp_path / 'v.nii.gz').error_map is None


@pytest.mark.parametrize('ending', ['.nii.gz', '.nii', '.ome.zarr', '.zarr'])
def test_the_names_beside_a_volume(ending):
    plan, errors = plan_and_error_map(Path(f'of/a.b{ending}'))
    assert (str(plan), str(errors)) == ('of/a.b-plan.json', f'of/a.b-error{ending}')


def test_numbers_and_what_differs(pair):
    page = compare_page([load_result(p) for p in pair])
    assert cells(page, 'PSNR 3D, peak the truth&#x27;s maximum') == ['30.00 dB', '★ 31.00 dB  (+1.00)']
    assert cells(page, 'Time to fit') == ['★ 10.0 s', '11.0 s  (+1.0)']
    assert cells(page, 'Gaussians') == ['100', '200  (+100)']  # neither is better
    assert cells(page, 'PSNR 3D as in R2-Gaussian: peak 1') == ['31.00 dB', '31.00 dB']
    assert cells(page, 'lambda_tv') == ['0', '0.1'] and '>iterations<' not in page
    assert 'lingo-mi fit 0' in page and 'Make b again' in page


def test_in_a_browser(pair, tmp_path):
    """The values at the crosshair come from the files, and differences are to the truth."""
    truth = np.random.default_rng(9).random(SHAPE).astype(np.float32)
    write_volume(tmp_path / 't.nii.gz', truth, Grid(SHAPE, 2.0), 'density per mm')
    code, out, err = run(COMPARE, *pair, '--truth', tmp_path / 't.nii.gz', '--out', tmp_path / 'c.html', variant=False)
    assert code == 0 and out.strip() == str(tmp_path / 'c.html'), err
    with browser() as chromium, opened(chromium, (tmp_path / 'c.html').as_uri()) as page:
        shown = readout(page)
        index = tuple(map(int, shown['voxel'].split(', ')))
        for path in pair:
            value = load_result(path)[1].volume()[index]
            assert abs(float(shown[path.name]) - value) < 1e-4
            assert abs(float(shown[f'Difference: {path.name} − Truth']) - (value - truth[index])) < 1e-4
        page.keyboard.press('s')
        assert page.locator('#slices canvas.picture').count() == 3 * 7
        captions = page.locator('#views figcaption').all_text_contents()
        assert captions == ['a', 'b', 'b − a']


def test_a_volume_of_reconstruct_beside_a_fit(pair, tmp_path):
    write_volume(tmp_path / 'x <b>.nii.gz', np.ones(SHAPE, np.float32), Grid(SHAPE, 2.0), 'density per mm')
    page = compare_page([load_result(pair[0]), load_result(tmp_path / 'x <b>.nii.gz')])
    assert 'x &lt;b&gt;' in page and 'x <b>' not in page
    assert cells(page, 'Time to fit') == ['10.0 s', '–']


def test_the_map_of_errors_beside_a_volume(pair, tmp_path):
    for name in ('x.nii.gz', 'x-error.nii.gz'):
        write_volume(tmp_path / name, np.ones(SHAPE, np.float32), Grid(SHAPE, 2.0), 'density per mm')
    page = compare_page([load_result(pair[0]), load_result(tmp_path / 'x.nii.gz')])
    assert '"name":"Error map: x"' in page and page.count('id="array-map') == 1
    write_volume(tmp_path / 'x-error.nii.gz', np.ones((9, 9, 9), np.float32), Grid(9, 2.0), 'density per mm')
    assert 'id="array-map' not in compare_page(
        [load_result(pair[0]), load_result(tmp_path / 'x.nii.gz')]
    )  # another grid


def test_views_of_other_angles_are_left_out(result, tmp_path):
    pair = result(tmp_path / 'a', 0), result(tmp_path / 'b', 1, test_angles=[0.0, 20.0, 11.0])
    assert 'id="array-views0"' not in compare_page([load_result(p) for p in pair])


def test_same_names_are_told_apart(result, tmp_path):
    pair = result(tmp_path / '1' / 'foot', 0), result(tmp_path / '2' / 'foot', 1)
    assert '<th scope="col">foot (2)</th>' in compare_page([load_result(p) for p in pair])


def test_other_grids(pair, tmp_path):
    write_volume(tmp_path / 'x.nii.gz', np.ones((9, 9, 9), np.float32), Grid(9, 2.0), 'density per mm')
    with pytest.raises(InputError, match='x: has 9 x 9 x 9 voxels of 2 x 2 x 2 mm, but a has 12 x 10 x 8'):
        compare_page([load_result(pair[0]), load_result(tmp_path / 'x.nii.gz')])


def test_other_places(pair, tmp_path):
    write_volume(
        tmp_path / 'x.nii.gz', np.ones(SHAPE, np.float32), Grid(SHAPE, 2.0, (50.0, 0.0, 0.0)), 'density per mm'
    )
    with pytest.raises(InputError, match='x: its voxels lie elsewhere than the voxels of a'):
        compare_page([load_result(pair[0]), load_result(tmp_path / 'x.nii.gz')])


@pytest.mark.parametrize('text', ['', '[]', '{"test_angles": 5}', '{"test_angles": ["x"]}', '[' * 200_000])
def test_damaged_numbers(pair, text):
    (pair[0] / 'metrics.json').write_text(text)
    with pytest.raises(InputError, match='metrics.json: is damaged'):
        load_result(pair[0])


@pytest.mark.parametrize(
    'change, message',
    [
        (lambda a, b, t: [a], 'a comparison is of 2 to 6 results, not of 1'),
        (lambda a, b, t: [a, t], 'there is no fit here'),
        (lambda a, b, t: [a, t / 'none'], 'none'),
        (lambda a, b, t: [a, b, '--out', t / 'x.png'], 'give a name that ends in .html'),
        (lambda a, b, t: [a, b, '--out', a / 'metrics.json' / 'x.html'], 'x.html'),
        (lambda a, b, t: [a, b, '--truth', t / 'none.nii.gz'], 'none.nii.gz'),
    ],
)
def test_bad_input(pair, tmp_path, monkeypatch, change, message):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(COMPARE, *change(*pair, tmp_path), variant=False)
    assert code == 2 and not out and err.startswith('error: ') and err.count('\n') == 1 and message in err
    assert not (tmp_path / 'compare.html').exists()


def test_nothing_is_replaced_without_force(pair, tmp_path):
    (tmp_path / 'c.html').write_text('mine')
    code, _, err = run(COMPARE, *pair, '--out', tmp_path / 'c.html', variant=False)
    assert code == 2 and 'exists already' in err and (tmp_path / 'c.html').read_text() == 'mine'
    assert run(COMPARE, *pair, '--out', tmp_path / 'c.html', '--force', variant=False)[0] == 0
    assert '</html>' in (tmp_path / 'c.html').read_text()
