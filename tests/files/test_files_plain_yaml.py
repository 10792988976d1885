"""YAML that a stranger wrote."""

import time

import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files import plain_yaml
from lingo_mi.files.plain_yaml import read_yaml


def written(folder, text):
    path = folder / 'scan.yml'
    path.write_text(text)
    return path


def test_plain_data(tmp_path):
    text = 'DSO: 1000\nDSD: 1.5e+3\nnDetector: [4, 5]\nmode: cone\nposes:\n- [1, 2]\n- [3, 4]\n'
    assert read_yaml(written(tmp_path, text)) == dict(
        DSO=1000, DSD=1500.0, nDetector=[4, 5], mode='cone', poses=[[1, 2], [3, 4]]
    )


BOMB = 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{b}: &{b} [{", ".join(["*" + a] * 9)}]\n' for a, b in zip('abcdefgh', 'bcdefghi')
)


@pytest.mark.parametrize(
    'text, match',
    [
        (BOMB, 'line 2 holds an alias'),
        ('a: &a [*a]\n', 'alias'),
        ('a: &a 1\nb: *a\n', 'alias'),
        ('[' * 20000, 'nested'),
        ('a: ' + '{b: ' * 5000, 'nested'),
        ('- ' * 3000, 'nested'),
        ('a: 1\nb: 2\na: 3\n', 'line 3 holds the name a twice'),
        ('a:\n  b: 1\n  b: 2\n', 'twice'),
        ('"a": 1\na: 2\n', 'twice'),
        ('a: ' + '9' * 5000, 'not valid YAML'),
        ('a: ' + 'x' * 20000, 'text of more than'),
        ('a: 2001-99-99', 'not valid YAML'),
        ('a: !!bool maybe', 'not valid YAML'),
        ('a: !!timestamp then', 'not valid YAML'),
        ('a: !!python/object/apply:os.system [true]', 'not valid YAML'),
        ('? [a]\n: 1', 'not valid YAML'),
        ('a: \x07', 'not valid YAML'),
    ],
)
def test_refuses_in_one_line(tmp_path, text, match):
    start = time.monotonic()
    with pytest.raises(InputError, match=match) as caught:
        read_yaml(written(tmp_path, text))
    assert '\n' not in str(caught.value) and len(str(caught.value)) < 300
    assert time.monotonic() - start < 5


def test_limits(tmp_path, monkeypatch):
    monkeypatch.setattr(plain_yaml, 'MOST_VALUES', 20)
    with pytest.raises(InputError, match='more than 20 values; put poses'):
        read_yaml(written(tmp_path, f'a: {list(range(30))}'))
    monkeypatch.setattr(plain_yaml, 'MOST_BYTES', 1 << 20)
    with pytest.raises(InputError, match='larger than 1 MiB'):
        read_yaml(written(tmp_path, 'a: 1 #' + ' ' * (1 << 20)))
    (tmp_path / 'scan.yml').write_bytes(b'\xff')
    with pytest.raises(InputError, match='not valid YAML'):
        read_yaml(tmp_path / 'scan.yml')
