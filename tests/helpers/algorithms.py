"""The iterative algorithms, by their names: what starts from any volume, and needs no cloud."""

from functools import partial

from lingo_mi.reconstruction import ALGORITHMS, PenalisedLeastSquares

ITERATIVE = {name: algorithm for name, algorithm in ALGORITHMS.items() if name not in ('fdk', 'refined', 'best')}
ITERATIVE['pls'] = partial(PenalisedLeastSquares, strength=1e-4)  # without it, views are held out, and two are too few
