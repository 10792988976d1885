"""Images and volumes in a notebook: HTML with one sprite each, and a slider over its frames.

Everything is in the markup, so that it stays in a saved notebook and in pages that are built from one. If scripts are off, the
middle frame shows.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

MOST_FRAMES, SIDE, LEAST = 48, 200, 12  # frames of a slider; pixels of their longer side, and of the other at least
PLANES = ((2, 'Axial', 'z'), (1, 'Coronal', 'y'), (0, 'Sagittal', 'x'))


def frames(
    images: np.ndarray,
    labels: Sequence[str],
    title: str,
    start: int | None = None,
    window: tuple[float, float] | None = None,
) -> str:
    """Images [n, row, column], first row at the top, as a figure with a slider.

    Parameters
    ----------
    labels : Sequence[str]
        Labels of the images, n.
    title : str
        Title of the figure.
    start : int or None
        The image that is seen first (default: the one in the middle).
    window : tuple[float, float] or None
        Values of black and of white (default: as `window_of` says).

    Examples
    --------
    >>> frames(scan.projections, ['0°', '7.2°'], 'projections')
    """
    from PIL import Image

    count = len(images)
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_FRAMES)).round().astype(int))
    by = max(1, -(-max(images.shape[1:]) // SIDE))
    small = np.asarray(images)[chosen][:, ::by, ::by].astype(np.float32)
    low, high = grey_range(small) if window is None else window
    grey = (np.clip((small - low) / max(high - low, 1e-12), 0, 1) * 255).astype(np.uint8)
    rows, columns = grey.shape[1:]
    file = io.BytesIO()
    Image.fromarray(grey.reshape(-1, columns)).save(file, 'png', optimize=True)
    sprite = base64.b64encode(file.getvalue()).decode('ascii')
    scale = SIDE / max(rows, columns)
    width, height = max(LEAST, round(columns * scale)), max(LEAST, round(rows * scale))
    first = int(np.abs(chosen - (count // 2 if start is None else start)).argmin())
    captions = [html.escape(str(labels[i])).replace('|', '/') for i in chosen]
    act = (
        f"this.previousElementSibling.style.backgroundPositionY=-{height}*this.value+'px';"
        "this.nextElementSibling.value=this.dataset.labels.split('|')[this.value]"
    )
    name = html.escape(title)
    slider = (
        f'<input type="range" min="0" max="{len(chosen) - 1}" value="{first}" aria-label="{name}" style="width:{width}px" '
        f'data-labels="{"|".join(captions)}" oninput="{act}">'
    )
    return (
        f'<figure style="display:inline-block;vertical-align:top;margin:0 1em .5em 0;width:{max(width, SIDE)}px">'
        f'<figcaption style="margin:0">{name}</figcaption>'
        f'<div role="img" aria-label="{name}" style="width:{width}px;height:{height}px;'
        f'background-size:{width}px {height * len(chosen)}px;'
        f'background-position-y:{-height * first}px;background-image:url(data:image/png;base64,{sprite})"></div>'
        f'{slider if len(chosen) > 1 else ""}<output style="display:block;font-size:.9em">{captions[first]}</output></figure>'
    )


def slices(volume: np.ndarray, spacing: ArrayLike, centre: ArrayLike = (0, 0, 0), unit: str = '1/mm') -> str:
    """Slices of a volume [x, y, z] across the three axes, each with a slider; places in mm.

    slices(found.volume, (1, 1, 1))
    """
    low, high = grey_range(volume)
    out = []
    for axis, name, letter in PLANES:
        stack = np.moveaxis(volume, axis, 0)
        if min(stack.shape[1:]) < 2:
            continue
        images = stack.transpose(0, 2, 1)[:, ::-1]  # up is the second of the axes that are left
        places = (np.arange(len(stack)) + 0.5 - len(stack) / 2) * np.asarray(spacing)[axis] + np.asarray(centre)[axis]
        energy = np.square(images, dtype=np.float64).sum((1, 2))
        labels = [f'{letter} = {place:.4g} mm' for place in places]
        out.append(frames(images, labels, f'{name}, {low:.3g} to {high:.3g} {unit}', int(energy.argmax()), (low, high)))
    return ''.join(out)


def grey_range(*arrays: np.ndarray) -> tuple[float, float]:
    """A common grey scale, by the last array: from 0, or from the 0.1th percentile if that is negative, to the 99.9th.

    If few values are not 0, to the largest of all arrays.
    """
    reference = arrays[-1]
    low, high = min(0.0, float(np.percentile(reference, 0.1))), float(np.percentile(reference, 99.9))
    return low, high if high > low else max(low + 1e-12, *(float(a.max()) for a in arrays))


def table(rows: dict[str, Any]) -> str:
    """Names and values."""
    cells = (
        f'<tr><th style="text-align:left">{html.escape(k)}</th><td style="text-align:left">{html.escape(str(v))}</td></tr>'
        for k, v in rows.items()
    )
    return f'<table style="display:inline-block;vertical-align:top;margin:0 1em .5em 0">{"".join(cells)}</table>'


def box(title: str, *parts: str) -> str:
    """Parts beside each other under a title."""
    return f'<div><div style="margin-bottom:.4em"><strong>{html.escape(title)}</strong></div>{"".join(parts)}</div>'
