"""The provenance of a table, as JSON beside it."""

import datetime
import json
import shutil
import subprocess
import sys

import pytest

from lingo_mi.validation import provenance


def test_beside_a_table(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, 'argv', ['python -m studies.tables', 'views', '--out', 'a b'])
    path = provenance.write_provenance(tmp_path / 'views.md')
    assert path == tmp_path / 'views.provenance.json' and [p.name for p in tmp_path.iterdir()] == [path.name]
    record = json.loads(path.read_text())
    assert list(record) == ['command', 'commit', 'date', 'machine', 'versions']
    assert record['command'] == "python -m studies.tables views --out 'a b'"
    assert record['machine'] and record['versions']['mitsuba'].startswith('3.')
    age = datetime.datetime.now(datetime.timezone.utc) - datetime.datetime.fromisoformat(record['date'])
    assert abs(age.total_seconds()) < 60


@pytest.mark.skipif(shutil.which('git') is None, reason='there is no git')
def test_commit_of_the_package_and_of_no_other_project(tmp_path, monkeypatch):
    """A checkout around a virtual environment is not the package's own."""

    def git(*words):
        identity = '-c', 'user.name=a', '-c', 'user.email=a@b.c'
        done = subprocess.run(['git', *identity, *words], cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    monkeypatch.setattr(provenance, 'ROOT', tmp_path)
    assert provenance.commit() is None
    git('init', '-q')
    git('commit', '-q', '--allow-empty', '-m', 'first')
    assert provenance.commit() is None
    (tmp_path / 'pyproject.toml').touch()
    assert provenance.commit() == git('rev-parse', 'HEAD')
    git('add', '.')
    assert provenance.commit() == git('rev-parse', 'HEAD') + '+'
