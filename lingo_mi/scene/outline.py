"""Read a scene file before Mitsuba does, whose parser ends the process if elements are nested too deep.

Files that it includes are looked at too. `expat` reads element by element and keeps nothing.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from xml.parsers import expat

from lingo_mi.common.errors import InputError, shown
from lingo_mi.files.ply import require_elements

MOST_BYTES = 64 * 2**20  # 100 000 views with a pose each are 20 MB
MOST_ELEMENTS = 20_000
MOST_DEPTH = 64  # Mitsuba's own scenes are about ten deep; its parser takes some ten thousand
MOST_INCLUDES = 15  # within each other, as in Mitsuba
_ENCODINGS = 'utf-8', 'us-ascii', 'ascii', 'iso-8859-1', 'latin-1'


def scene_files(path: PathLike | str, parameters: dict | None = None) -> list[Path]:
    """A scene file, those that it includes, and all files that its texts name, if they exist, also in LINGO_MI_DATA.

    Raises
    ------
    InputError
        As `outline`.
    """
    reader = _Reader({name: str(value) for name, value in (parameters or {}).items()})
    reader.at(Path(path), 0)
    if folder := os.environ.get('LINGO_MI_DATA'):
        reader.folders.append(Path(folder))
    return sorted(
        reader.scenes | {file for text in reader.texts for file in reader.places(text) if os.path.isfile(file)}
    )


def outline(path: PathLike | str, parameters: dict | None = None) -> set[str]:
    """Names of a scene file's own `<default>` parameters.

    Parameters
    ----------
    parameters : dict or None
        Values for them.

    Raises
    ------
    InputError
        If the file is missing or no regular one, is not XML, declares a document type, whose entities may stand for more than
        memory holds, or is larger or deeper than any scene; and so for the files that it includes. Likewise if a shape's or a
        texture's file is a device or a pipe, which has no end.
    """
    reader = _Reader({name: str(value) for name, value in (parameters or {}).items()})
    reader.at(Path(path), 0)
    return reader.defaults


@dataclass
class _Reader:
    """State of the reader after a part of the files.

    Parameters
    ----------
    values : dict[str, str]
        Values of the scene parameters.
    folders : list[Path]
        Folders in which names are looked for.
    scenes : set[Path]
        The files themselves.
    texts : set[str]
        Values of all strings.
    elements : int
        Number of elements of all files so far.
    """

    values: dict[str, str]
    defaults: set[str] = field(default_factory=set)
    folders: list[Path] = field(default_factory=lambda: [Path()])
    scenes: set[Path] = field(default_factory=set)
    texts: set[str] = field(default_factory=set)
    elements: int = 0

    def at(self, path: Path, included: int):
        """Read a file that is `included` files deep."""
        if included > MOST_INCLUDES:
            raise InputError(f'{path}: is included more than {MOST_INCLUDES} files deep')
        _require_scene(path)
        self.scenes.add(path)
        self.folders.append(path.parent)
        more, depth = [], 0

        def begin(tag, attributes):
            nonlocal depth
            depth, self.elements = depth + 1, self.elements + 1
            if depth > MOST_DEPTH or self.elements > MOST_ELEMENTS:
                raise InputError(
                    f'{path}: line {parser.CurrentLineNumber}: a scene has at most {MOST_ELEMENTS} elements, '
                    f'{MOST_DEPTH} of them within each other'
                )
            if tag == 'default':
                self.values.setdefault(attributes.get('name', ''), attributes.get('value', ''))
                if not included:
                    self.defaults.add(attributes.get('name', ''))
            elif tag == 'path':
                self.folders += [folder / self.filled(attributes.get('value', '')) for folder in self.folders]
            elif tag == 'include':
                more.append(self.filled(attributes.get('filename', '')))
            elif tag == 'string':
                self.texts.add(text := self.filled(attributes.get('value', '')))
                if attributes.get('name') == 'filename':
                    self.require_readable(path, text)

        def end(tag):
            nonlocal depth
            depth -= 1

        parser = expat.ParserCreate()
        parser.XmlDeclHandler = lambda version, encoding, alone: _require_encoding(path, encoding)
        parser.StartDoctypeDeclHandler = lambda *_: _refuse_document_type(path)
        parser.StartElementHandler, parser.EndElementHandler = begin, end
        try:
            parser.Parse(path.read_bytes(), True)  # at once: in parts, a long attribute is read again for every part
        except (expat.ExpatError, ValueError, LookupError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f'{path}: this is not a scene in XML ({error})') from None
        except OSError as error:
            raise InputError(f'{path}: cannot be read ({error.strerror}); check its permissions') from None
        for name in more:
            for file in self.places(name):
                self.at(file, included + 1)

    def filled(self, text: str) -> str:
        """A value with the parameters in it replaced, longer names first."""
        for name in sorted(self.values, key=len, reverse=True):
            text = text.replace(f'${name}', self.values[name]) if name else text
        return text

    def places(self, name: str) -> Iterator[Path]:
        """The files that a name may mean. Mitsuba says if there is none."""
        for path in {(folder / name).absolute() for folder in self.folders}:
            if name and os.path.lexists(path) and not path.is_dir():
                yield path

    def require_readable(self, scene: Path, name: str):
        for path in self.places(name):
            if path.exists() and not path.is_file():
                raise InputError(f'{scene}: {name} is not a regular file, but a device or a pipe; name another')
            if path.suffix.lower() == '.ply' and path.exists():
                require_elements(path)


def _require_scene(path: Path):
    """Raises InputError unless a path names a regular file that is not larger than scenes are."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        raise InputError(f'{path}: there is no such scene') from None
    if not stat.S_ISREG(status.st_mode):
        what = 'a folder' if stat.S_ISDIR(status.st_mode) else 'a device or a pipe'
        raise InputError(f'{path}: is {what}, not a scene')
    if status.st_size > MOST_BYTES:
        raise InputError(
            f'{path}: has {status.st_size / 2**20:,.0f} MiB, but a scene has at most {MOST_BYTES >> 20}; put numbers into '
            'files that it names'
        )


def _require_encoding(path: Path, encoding: str | None):
    if encoding is not None and encoding.lower() not in _ENCODINGS:
        raise InputError(f'{path}: is encoded as {shown(encoding)}; Mitsuba reads UTF-8')


def _refuse_document_type(path: Path):
    raise InputError(f'{path}: declares a document type, which scenes do not have; remove <!DOCTYPE ...>')
