"""A page that is not yet in a file: to look at in a notebook or in a browser."""

from __future__ import annotations

import html
import tempfile
import webbrowser
from os import PathLike
from pathlib import Path

from lingo_mi.storage.file_access import as_path, new_file, write_text, writing


class Page:
    """An interactive page, which loads nothing. In a notebook it shows itself in a frame of its own.

    page = result.view()
    page.save('foot.html')
    page.open()
    """

    def __init__(self, text: str):
        """text: the page, HTML."""
        self.text = text

    def save(self, path: str | PathLike, *, force: bool = False) -> Path:
        """Write the page; returns the path.

        Parameters
        ----------
        force : bool
            Replace an earlier file.

        Raises
        ------
        InputError
            If the file is there already, or cannot be written.
        """
        path = as_path('path', path)
        with writing(path):
            new_file(path, force)
            write_text(path, self.text)
        return path

    def open(self) -> Path:
        """Show the page in the browser, from a temporary file; returns its path."""
        path = Path(tempfile.mkdtemp(prefix='lingo_mi-')) / 'report.html'
        write_text(path, self.text)
        webbrowser.open(path.as_uri())
        return path

    def __repr__(self) -> str:
        return f'Page({len(self.text) / 1e6:.1f} MB): .open() shows it in a browser, .save(path) writes it'

    def _repr_html_(self) -> str:
        frame = 'width:100%;height:900px;border:1px solid #8888;border-radius:8px'
        return f'<iframe sandbox="allow-scripts" title="result" style="{frame}" srcdoc="{html.escape(self.text)}"></iframe>'
