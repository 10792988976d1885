"""The fits that `python -m studies.recipes` runs, and the results that it takes for them. The fits themselves are not run."""

import json
import runpy
import sys
from pathlib import Path

import pytest

from lingo_mi.common.errors import InputError
from studies.recipes import comparison as study

METRICS = dict(
    psnr_2d=30.0,
    psnr_2d_r2=29.0,
    ssim_2d_r2=0.9,
    psnr_3d_r2=25.0,
    ssim_3d_r2=0.8,
    ipsd=0.02,
    ipsd_targets=10,
    gaussians=100,
    iterations=7,
    seconds_init=0.1,
    seconds_fit=2.0,
    history=[dict(seconds=1.0, psnr_2d=20.0, psnr_3d_r2=15.0)],
)


@pytest.fixture
def recipes(monkeypatch, capsys, tmp_path):
    """Exit code, standard output and standard error of `recipes.py a.xml ARGS`."""

    def call(*args):
        monkeypatch.setattr(sys, 'argv', ['recipes.py', 'a.xml', '--out', str(tmp_path), *args])
        with pytest.raises(SystemExit) as stop:
            runpy.run_module('studies.recipes', run_name='__main__')
        return stop.value.code, *capsys.readouterr()

    return call


@pytest.fixture
def fits(monkeypatch):
    """The commands of the fits that were asked for; each ends at once."""
    commands = []

    def fit(command):
        commands.append(command[2:])
        out = Path(command[command.index('--out') + 1])
        out.mkdir(parents=True)
        (out / 'metrics.json').write_text(json.dumps(METRICS))
        return 0

    monkeypatch.setattr(study, 'run_command', fit)
    return commands


@pytest.mark.thorough
def test_a_fit_of_other_settings_is_another(recipes, fits, tmp_path):
    def asked(*args):
        fits.clear()
        code, text, err = recipes(*args)
        assert code == 0 and '| a |' in text, err
        return [[word for flag, word in zip(command, command[1:]) if flag == '-D'] for command in fits]

    assert asked('--methods', 'r2', 'fast') == [['iterations=5000'], []]
    assert asked('--methods', 'r2', 'fast') == []
    assert asked('--methods', 'r2', '--iterations', '7') == [['iterations=7']]
    assert asked('--methods', 'r2:iterations=9,lambda_tv=0', '-D', 'pixels=8') == [
        ['pixels=8', 'iterations=9', 'lambda_tv=0']
    ]
    assert asked('--methods', 'r2', '-D', 'iterations=9') == [['iterations=9']]
    assert asked('--methods', 'r2', '--views', '3') == [['iterations=5000']]
    assert (tmp_path / 'recipes.png').exists()
    assert '| a | r2 |' in (tmp_path / 'recipes.md').read_text()
    assert 'studies.recipes a.xml' in json.loads((tmp_path / 'recipes.provenance.json').read_text())['command']


def test_an_interrupted_fit_goes_on_and_a_failed_one_is_named(recipes, monkeypatch, tmp_path):
    commands = []
    monkeypatch.setattr(study, 'run_command', lambda command: commands.append(command) or 3)
    folder = tmp_path / 'a_25_fast'
    folder.mkdir()
    (folder / 'checkpoint.npz').touch()
    code, _, err = recipes('--methods', 'fast')
    assert code == 2 and '--resume' in commands[0]
    assert err.splitlines()[-1] == 'error: a.xml: lingo-mi fit --method fast failed with exit code 3'


@pytest.mark.parametrize('method', ['nerf', 'r2:V=1', 'r2:lambda_tv'])
def test_bad_methods(recipes, fits, method):
    code, _, err = recipes('--methods', 'r2', method)
    assert code == 2 and err.startswith('error: ') and err.count('\n') == 1 and not fits


def test_a_scene_of_the_same_name_is_another(tmp_path):
    comparison, scene = study.Comparison(tmp_path / 'out'), tmp_path / 'a.xml'
    folder, _ = comparison.plan(scene, 'r2')
    for text in ('<scene/>', '<scene version="3.0.0"/>'):
        scene.write_text(text)
        comparison._require_same_scene(folder, scene)  # there is no fit yet
    folder.mkdir()
    comparison._require_same_scene(folder, scene)
    scene.write_text('<scene/>')
    with pytest.raises(InputError, match='another scene of this name'):
        comparison._require_same_scene(folder, scene)


def test_a_value_that_is_a_path_makes_no_folders(tmp_path):
    comparison = study.Comparison(tmp_path, changes=('projections=/data/x.npy',))
    folder, command = comparison.plan('a.xml', 'fast')
    assert folder.parent == tmp_path and folder.name.endswith('projections=%2Fdata%2Fx.npy')
    assert command[-1] == 'projections=/data/x.npy'


def test_many_settings_make_a_name_that_a_folder_may_have(tmp_path):
    many = [','.join(f'rate_{name}=1e-{i},1e-3' for name in ('centre', 'density', 'scale') * 5) for i in (2, 4)]
    folders = {study.Comparison(tmp_path).plan('a.xml', f'fast:{changes}')[0] for changes in many}
    assert len(folders) == 2
    for folder in folders:
        folder.mkdir()


@pytest.mark.parametrize('name', ['metrics.json', 'scenes.json'])
def test_damaged_results(tmp_path, name):
    scene, comparison = tmp_path / 'a.xml', study.Comparison(tmp_path)
    scene.write_text('<scene/>')
    folder, _ = comparison.plan(scene, 'r2')
    folder.mkdir()
    (folder / 'metrics.json').write_text('{}')
    (tmp_path / name if name == 'scenes.json' else folder / name).write_text('[1]')
    with pytest.raises(InputError, match=f'{name}: is damaged'):
        comparison.result(scene, 'r2')
