"""The iterative algorithms, by their names: what starts from any volume, and needs no cloud."""

from lingo_mi.reconstruction import ALGORITHMS

ITERATIVE = {name: algorithm for name, algorithm in ALGORITHMS.items() if name not in ('fdk', 'refined', 'best')}
