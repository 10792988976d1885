"""The order in which the steps of a fit see the views: every view once before any view twice."""

from __future__ import annotations

import math

import numpy as np

from lingo_mi.geometry.base import Geometry

ORDERS = 'random', 'golden'
GOLDEN = (math.sqrt(5) - 1) / 2


def view_order(geometry: Geometry, order: str, rng: np.random.Generator) -> list[int]:
    """The numbers of all views, each once, in the order to see them in.

    After the golden-angle order of radial MRI (Winkelmann et al., "An optimal radial profile order based on the golden ratio for
    time-resolved MRI", IEEE Trans. Med. Imaging 26, 2007).

    Parameters
    ----------
    order : str
        One of ORDERS. 'random': a random permutation. 'golden': around the axis, from a random view on, in steps of the golden
        section of their number, so that any few views in a row lie well apart.

    Examples
    --------
    >>> view_order(scan.geometry, 'golden', np.random.default_rng(0))
    """
    n = len(geometry)
    if order == 'random':
        return rng.permutation(n).tolist()
    step = round(n * GOLDEN)
    while math.gcd(step, n) > 1:
        step += 1
    around = np.argsort(np.mod(geometry.angles, 2 * np.pi), kind='stable')
    return around[(rng.integers(n) + step * np.arange(n)) % n].tolist()
