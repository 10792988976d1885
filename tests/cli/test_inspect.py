"""`lingo-mi inspect` prints and draws."""

from dataclasses import replace

import pytest

from helpers.scans import small_dataset
from lingo_mi.cli import main
from lingo_mi.files.scans import write_scan


def test_inspect(tmp_path, monkeypatch, capsys):
    write_scan(tmp_path / 'scan.npy', small_dataset().train, 'npy')
    out = tmp_path / 'look.png'
    monkeypatch.setattr('sys.argv', ['lingo-mi', 'inspect', str(tmp_path / 'scan.npy'), '--out', str(out)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0 and out.read_bytes().startswith(b'\x89PNG')
    assert '3 views of 4 x 6 pixels' in capsys.readouterr().out


def test_an_earlier_file_is_kept(tmp_path, monkeypatch, capsys):
    write_scan(tmp_path / 'scan.npy', small_dataset().train, 'npy')
    picture = tmp_path / 'scan.png'
    picture.write_text('mine')
    monkeypatch.chdir(tmp_path)

    def inspect(*options):
        monkeypatch.setattr('sys.argv', ['lingo-mi', 'inspect', 'scan.npy', *options])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code, capsys.readouterr().err

    code, err = inspect()
    assert code == 2 and 'scan.png: exists already' in err and picture.read_text() == 'mine'
    before = (tmp_path / 'scan.npy').read_bytes()
    code, err = inspect('--out', 'scan.npy', '--force')
    assert code == 2 and 'ends in .png' in err and (tmp_path / 'scan.npy').read_bytes() == before
    assert inspect('--force')[0] == 0 and picture.read_bytes().startswith(b'\x89PNG')


def test_views_without_a_signal(tmp_path, monkeypatch, capsys):
    scan = small_dataset().train
    write_scan(tmp_path / 'scan.npy', replace(scan, projections=0 * scan.projections), 'npy')
    monkeypatch.setattr(
        'sys.argv', ['lingo-mi', 'inspect', str(tmp_path / 'scan.npy'), '--out', str(tmp_path / 'a.png')]
    )
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0 and 'black' in capsys.readouterr().out
