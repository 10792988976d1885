"""Sizes of the measurements."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """Sizes of the measurements.

    Parameters
    ----------
    gaussians, pixels, box
        The cloud, the side of its square panel, mean pixels in a box of 3 standard deviations.
    few : int
        Gaussians of the same kind if slow methods take part.
    grids : tuple
        Voxels along a side of the grids.
    rounds, seconds
        Repeats of a method, fewer once it has taken so long altogether.
    pairs, counts, panels : tuple
        The sweeps: pairs of a pixel and a Gaussian, Gaussians, pixels along a side.
    crowd : int
        Gaussians among which one as large as the scene is put.
    phantoms : tuple
        Voxels and pixels along a side of the fits' phantom.
    points : tuple
        Gaussians a fit starts with.
    iterations : tuple
        Iterations of a fit.
    views : int
        Views of a fit, and as many held out.
    samples : tuple
        On a ray of a neural field.
    field_pixels : int
        Along a side of its panel.
    """

    gaussians: int = 20_000
    few: int = 4_000
    pixels: int = 512
    box: float = 234.0
    grids: tuple = (64, 128, 256)
    rounds: int = 9
    seconds: float = 6.0
    pairs: tuple = (1e4, 1e5, 1e6, 1e7, 1e8)
    counts: tuple = (100, 1_000, 10_000, 100_000, 1_000_000)
    panels: tuple = (64, 128, 256, 512, 1024, 2048)
    crowd: int = 50_000
    phantoms: tuple = (64, 128)
    points: tuple = (1_000, 4_000, 16_000)
    iterations: tuple = (150, 400, 1_000)
    views: int = 25
    samples: tuple = (24, 48, 96, 192, 384, 768)
    field_pixels: int = 32


FULL = Sizes()
QUICK = Sizes(
    gaussians=4_000,
    few=1_000,
    pixels=256,
    grids=(64, 128),
    rounds=5,
    seconds=0.7,
    pairs=(1e4, 1e5, 1e6, 1e7),
    counts=(100, 1_000, 10_000, 100_000),
    panels=(64, 256, 1024),
    crowd=10_000,
    phantoms=(64,),
    points=(1_000, 4_000),
    iterations=(50, 150),
    views=16,
    samples=(24, 48, 96, 192),
    field_pixels=16,
)
