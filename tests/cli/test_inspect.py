"""`lingo-mi inspect` prints and draws."""

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
