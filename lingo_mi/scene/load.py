"""Loads a scene and finds its scanner."""

from __future__ import annotations

import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import mitsuba as mi

from lingo_mi.common.errors import InputError
from lingo_mi.common.interrupts import noticed
from lingo_mi.effects.forward import find_effects
from lingo_mi.scene.checks import check_memory, thinned
from lingo_mi.scene.outline import outline


@dataclass(frozen=True)
class LoadedScene:
    """A scene (`mi.Scene`), its scanner (the plugin `ct_scanner`) and their origin."""

    scene: Any
    scanner: Any
    path: Path

    @property
    def name(self) -> str:
        return self.path.stem


def load_scene(path: PathLike | str, parameters: dict | None = None, slab: int = 0) -> LoadedScene:
    """Load a Mitsuba scene with a `ct_scanner`.

    Parameters
    ----------
    parameters : dict or None
        Values for the scene's own `<default>` names.
    slab : int
        Slices of the volume that will be in memory at once (0: all).

    Raises
    ------
    InputError
        In one line, for whatever mitsuba or a plugin finds wrong, and if memory does not suffice.
    """
    path = Path(path)
    accepted = outline(path, parameters)
    unknown = set(parameters or {}) - accepted
    if unknown:
        raise InputError(
            f'{path}: the scene has no parameter {", ".join(sorted(unknown))}; '
            f'it has {", ".join(sorted(accepted)) or "none"}'
        )
    scene = load_file(path, parameters)
    if not isinstance(scene, mi.Scene):
        raise InputError(f'{path}: this is a {type(scene).__name__}, not a scene')
    scanner = next((s for s in scene.sensors() if hasattr(s, 'geometry')), None)
    if scanner is None:
        raise InputError(f'{path}: the scene has no scanner; add <sensor type="ct_scanner">')
    check_memory(thinned(scanner.geometry, slab), scanner.test_geometry)
    try:
        find_effects(scene, scanner)
    except InputError as error:
        raise InputError(f'{path}: {error}') from None
    return LoadedScene(scene, scanner, path)


def load_file(path: Path, parameters: dict | None = None) -> Any:
    """Load a scene file with Mitsuba.

    Raises
    ------
    InputError
        In one line, for whatever it finds wrong, and KeyboardInterrupt after Ctrl-C, also within a plugin.
    """
    try:
        str(path).encode('utf-8')
    except UnicodeEncodeError:
        raise InputError(
            f'{path}: Mitsuba reads files whose names are UTF-8; give it and its folders such names'
        ) from None
    with noticed():
        try:
            # With one thread: with several, Mitsuba rarely fails to create a plugin (bad_alloc in a gridvolume, 1 in thousands).
            return mi.load_file(str(path), parallel=False, **(parameters or {}))
        except Exception as error:  # Mitsuba wraps a plugin's own exceptions in RuntimeErrors of many lines
            if 'KeyboardInterrupt' in str(error).splitlines()[-1]:
                raise KeyboardInterrupt from None
            raise InputError(f'{path}: {plain(error)}') from None


def defaults(path: PathLike | str) -> set[str]:
    """Names of a scene file's `<default>` parameters.

    Raises
    ------
    InputError
        If the file is missing or no scene (see `outline`).
    """
    return outline(path)


def plain(error: Exception) -> str:
    """The one line of an error that helps the user: a plugin's own message with the element's line, else the core of
    Mitsuba's message."""
    text = str(error)
    ours = re.findall(r'InputError: (.*)', text)
    if ours:
        lines = re.findall(r'\(line (\d+), col \d+\)', text)
        return (f'line {lines[-1]}: ' if lines else '') + ours[-1].strip()
    if '"ellipsoids"' in text and '(sizes: 0, 1)' in text:  # Mitsuba's message for an empty cloud
        return 'the shape ellipsoids holds no Gaussian: give it a file or data of at least one'
    if 'Could not initialize OptiX' in text:
        return (
            'Mitsuba needs OptiX to load a scene on a GPU, and the NVIDIA driver here has none (in a container: '
            'NVIDIA_DRIVER_CAPABILITIES=all); take variant=llvm_ad_mono, or give an array or a scan instead of a scene'
        )
    text = re.sub(r'Traceback \(most recent call last\):\n(?:[ \t].*\n)*', '', text)
    lines = [re.sub(r'^\[[\w.]+:\d+\] *', '', line.strip()) for line in text.splitlines() if line.strip()]
    return ' '.join(lines)[:400] or type(error).__name__
