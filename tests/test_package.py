"""The content of an installation: every module, plugin and scene of the checkout."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import lingo_mi

ROOT = Path(__file__).parents[1]
PLACES = {'lingo_mi': 'lingo_mi', 'plugins': 'lingo_mi/plugins', 'scenes': 'lingo_mi/scenes'}
KINDS = {'.py', '.xml', '.ply', '.cpp', '.json'}


def files(folder: Path) -> set[str]:
    """Paths of the source and data files below a folder, not those that links in it lead to."""
    paths = (path.relative_to(folder) for path in folder.rglob('*') if path.suffix in KINDS and path.is_file())
    return {path.as_posix() for path in paths if not any((folder / p).is_symlink() for p in path.parents)}


@pytest.fixture(scope='module')
def built(tmp_path_factory):
    """The tree that a wheel is packed from, built from a copy of the checkout."""
    pytest.importorskip('setuptools', '77', reason='building needs setuptools 77 or later')
    folder = tmp_path_factory.mktemp('package')
    for name in PLACES:  # links lead from the package to the folders beside it
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns('__pycache__'))
    for name in ('pyproject.toml', 'README.md', 'LICENSE'):
        shutil.copy(ROOT / name, folder)
    command = [sys.executable, '-c', 'from setuptools import setup; setup()', 'build_py', '--build-lib', 'built']
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / 'built'


def test_an_installation_holds_every_file(built):
    expected = {f'{place}/{name}' for source, place in PLACES.items() for name in files(ROOT / source)}
    held = files(built)
    assert held == expected
    assert {
        'lingo_mi/scenes/x3d_foot.xml',
        'lingo_mi/scenes/effects/psf.xml',
        'lingo_mi/scenes/meshes/flange.ply',
        'lingo_mi/plugins/lingo_xray.py',
        'lingo_mi/validation/limit.cpp',
        'lingo_mi/validation/cuda_counts.json',
    } <= held


def test_neither_tests_nor_scripts_nor_studies_are_installed(built):
    assert [path.name for path in built.iterdir()] == ['lingo_mi']


def test_import_from_the_folder_that_holds_the_clone(tmp_path):
    """The clone's folder has the package's name but is not a package: Python must go on to the path of the installation."""
    (tmp_path / 'lingo_mi').symlink_to(ROOT)
    code = 'import lingo_mi, lingo_mi.plugins, lingo_mi.scenes; print(lingo_mi.__version__)'
    environment = os.environ | {'PYTHONPATH': str(ROOT)}
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == lingo_mi.__version__


def test_the_citation_has_the_package_version():
    lines = (ROOT / 'CITATION.cff').read_text().splitlines()
    assert f'version: {lingo_mi.__version__}' in lines


def test_zenodo_is_told_what_the_citation_says():
    cited = yaml.safe_load((ROOT / 'CITATION.cff').read_text())
    deposit = json.loads((ROOT / '.zenodo.json').read_text())
    assert deposit['creators'] == cited['authors'] and 'version' not in deposit
    assert {name: deposit[name] for name in ('title', 'license', 'keywords')} == {
        name: cited[name] for name in ('title', 'license', 'keywords')
    }


CONDA = {'openexr': 'openexr-python', 'matplotlib': 'matplotlib-base'}


def test_conda_takes_what_pip_takes():
    """The exception is LLVM, which conda's drjit brings."""
    recipe = yaml.safe_load((ROOT / '.github' / 'conda' / 'recipe.yaml').read_text())
    named = re.search(r'^dependencies = \[\n(.*?)^\]', (ROOT / 'pyproject.toml').read_text(), re.MULTILINE | re.DOTALL)[
        1
    ]
    needed = set()
    for name, versions in re.findall(r'"([\w-]+)([^";]*)"', named):
        needed.add(f'{CONDA.get(name.lower(), name.lower())} {versions}')
    assert {need for need in recipe['requirements']['run'] if not need.startswith('python ')} == needed
