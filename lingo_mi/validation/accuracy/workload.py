"""The cloud for measurements of images."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.projectors.view import View
from lingo_mi.validation.closed_form import image_and_gradients
from lingo_mi.validation.pairs import count_pairs

DSO, DSD, PANEL = 7.8125, 11.71875, 4.0  # X3D's scanner, in units of half the volume's side
BALL = 0.625  # radius of the ball of centres
SPREAD = 1.16  # mean of a box's side over the side for a Gaussian of the median scale


class Workload:
    """A random cloud before a scanner: as arrays, as a scene, and as float64 truth.

    Parameters
    ----------
    order : int
        Order of the Gauss-Legendre rule for pixel means; 0 for the rays through pixel centres.
    giant : bool
        Whether the first Gaussian is as large as the whole ball.
    """

    def __init__(
        self, gaussians: int, pixels: int, box: float, order: int = 0, mode: str = 'cone', giant: bool = False
    ):
        rng = np.random.default_rng(0)
        n = gaussians
        self.sigma = np.sqrt(box) / 6 / SPREAD  # pixels, of the median scale
        sigma = self.sigma * (PANEL / pixels) * DSO / DSD
        direction = rng.normal(size=(n, 3))
        centre = direction / np.linalg.norm(direction, axis=1, keepdims=True) * BALL * rng.random((n, 1)) ** (1 / 3)
        rotation = rng.normal(size=(n, 4))
        rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
        columns = centre, sigma * np.exp(rng.normal(0, 0.35, (n, 3))), rotation, rng.uniform(0.1, 1, n)
        if giant:
            columns[0][0], columns[1][0] = 0, BALL / 3
        self.columns = [x.astype(np.float32) for x in columns]
        self.pixels, self.order = pixels, order
        self.weights = rng.normal(size=(pixels, pixels)).astype(np.float32)
        self.geometry = CircularGeometry(
            DSO=DSO,
            DSD=DSD,
            nDetector=(pixels, pixels),
            dDetector=(PANEL / pixels, PANEL / pixels),
            angles=np.array([0.4]),
            mode=mode,
            grid=Grid(8, 1 / 4),
        )
        self.view = View.of(self.geometry.rays(), 0, pixels, pixels)
        self.data = mi.TensorXf(np.concatenate(self.columns[:3], 1))
        self.density = mi.TensorXf(self.columns[3][:, None])
        self.scene = mi.load_dict(
            dict(
                type='scene',
                cloud=dict(type='ellipsoids', data=self.data, density=self.density),
                scanner=dict(
                    type='ct_scanner',
                    mode=mode,
                    DSO=DSO,
                    DSD=DSD,
                    nDetector=str(pixels),
                    nVoxel='8',
                    dVoxel='.25',
                    dDetector=repr(PANEL / pixels),
                    angles=repr(float(np.degrees(0.4))),
                ),
            )
        )
        self._truth: tuple[np.ndarray, dict[str, np.ndarray]] | None = None

    @property
    def truth(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """The image [v, u] and the derivatives by name."""
        if self._truth is None:
            self._truth = image_and_gradients(
                self.columns, self.geometry.rays(), (self.pixels, self.pixels), self.weights, self.order
            )
        return self._truth

    def gaussians(self) -> tuple[Any, Any, Any, Any]:
        """Centre, scale, rotation and density as new Dr.Jit arrays."""
        centre, scale, rotation = ([mi.Float(c) for c in x.T] for x in self.columns[:3])
        return mi.Point3f(*centre), mi.Vector3f(*scale), mi.Vector4f(*rotation), mi.Float(self.columns[3])

    def pairs(self, extent: float) -> float:
        """`count_pairs` of the cloud."""
        return count_pairs(self.gaussians(), self.view, extent)
