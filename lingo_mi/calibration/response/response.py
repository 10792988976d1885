"""All models of a response together: fitted to pairs of expected and measured views, applied, and undone. NumPy."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from lingo_mi.calibration.drift import scan_times
from lingo_mi.calibration.response.air import Air, Gain
from lingo_mi.calibration.response.curve import Curve
from lingo_mi.calibration.response.part import SMOOTH, Place, ResponsePart
from lingo_mi.calibration.response.pixels import Pixels
from lingo_mi.calibration.response.scatter import ScatterImage
from lingo_mi.geometry.base import Geometry

STEPS = 4  # of Gauss and Newton
SAMPLES = 400_000  # pixels that are used, of all views together
ROBUST = 3.0  # median deviations beyond which a pixel counts less (Huber)


@dataclass
class Response:
    """Response of a scan's detector to line integrals, in parts. The first part acts first.

    Parameters
    ----------
    geometry : Geometry
        Geometry of the scan, whose views define the time (`calibration.drift.times`).
    parts : list[ResponsePart]
        With their numbers.

    Examples
    --------
    >>> response = Response.of(scan.geometry, air='view', curve=2, highest=1.2)
    >>> response.fit(expected, scan.projections)
    >>> line_integrals = response.undone(scan.projections, scan.geometry)
    """

    geometry: Geometry
    parts: list[ResponsePart]

    @classmethod
    def of(
        cls,
        geometry: Geometry,
        *,
        air: str = 'off',
        gain: str = 'off',
        curve: int = 0,
        scatter: str = 'off',
        pixels: str = 'off',
        highest: float = 1.0,
    ) -> Response | None:
        """Nothing found yet. None without any part.

        Parameters
        ----------
        air, gain : str
            'off', 'smooth' or 'view'.
        curve : int
            Number of coefficients, the same in all views.
        scatter : str
            'off', or 'one' for the same image in all views.
        pixels : str
            'off', or 'one' for an offset of each pixel, the same in all views.
        highest : float
            The highest line integral, for the curve.
        """
        parts: list[ResponsePart] = [
            *([Gain(gain)] if gain != 'off' else []),
            *([Curve('one', curve, highest)] if curve else []),
            *([ScatterImage(scatter)] if scatter != 'off' else []),
            *([Air(air)] if air != 'off' else []),
            *([Pixels(pixels, geometry.nDetector)] if pixels != 'off' else []),
        ]
        rows = dict(one=1, smooth=min(SMOOTH, len(geometry) - 1) + 1, view=len(geometry))
        for part in parts:
            part.values = np.zeros((rows[part.varies], len(part.deviations)))
        return cls(geometry, parts) if parts else None

    def applied(self, p: np.ndarray, geometry: Geometry) -> np.ndarray:
        """Return the measured values of line integrals [view, v, u] in the views of a geometry, float32. Views that are not in
        the scan get the response that was found for their time."""
        return self._through(p, geometry, self.parts, lambda part: part.apply)

    def undone(self, m: np.ndarray, geometry: Geometry) -> np.ndarray:
        """The line integrals of measured views [view, v, u], float32."""
        return self._through(m, geometry, self.parts[::-1], lambda part: part.undo)

    def fit(self, expected: np.ndarray, measured: np.ndarray, valid: np.ndarray | None = None) -> None:
        """Find all numbers by least squares with Huber's weights: what they make of the expected line integrals is measured.
        Offsets of pixels are found from what the other parts leave.

        Parameters
        ----------
        expected, measured : ndarray
            [view, v, u] of the scan.
        valid : ndarray or None
            Bool, likewise; None: all.
        """
        pixels = [part for part in self.parts if isinstance(part, Pixels)]
        if pixels:
            others = Response(self.geometry, [part for part in self.parts if not isinstance(part, Pixels)])
            if others.parts:
                others.fit(expected, Response(self.geometry, [*pixels]).undone(measured, self.geometry), valid)
                expected = others.applied(expected, self.geometry)
            return pixels[0].find(expected, measured, valid)
        every = max(1, int(np.ceil(np.sqrt(measured.size / SAMPLES))))
        rows, columns = (
            slice(every // 2 if n > every else 0, None, every if n > every else 1) for n in measured.shape[1:]
        )
        place = _place(measured.shape[1:])
        place = Place(place.y[rows, columns], place.x[rows, columns])
        p, m = (np.asarray(x[:, rows, columns], float) for x in (expected, measured))
        inside = np.ones(p.shape, bool) if valid is None else valid[:, rows, columns]
        matrices = self._in_time(np.linspace(-1, 1, len(p)), np.arange(len(p)))
        for _ in range(STEPS):
            self._step(p, m, inside, place, matrices)

    def arrays(self) -> dict[str, np.ndarray]:
        """All numbers by name, for a checkpoint."""
        return {f'response.{part.name}': part.values for part in self.parts}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore the output of `arrays`."""
        for part in self.parts:
            part.values = np.array(arrays[f'response.{part.name}'], float)

    def names(self) -> dict[str, float]:
        """Return the names of the numbers in `changed`, each with a step for differences. 'air0' is the constant, 'air1' the
        first polynomial in time, and 'curve0_1' the second coefficient. The names that `hold` takes out are left out."""
        steps = {}
        for part in self.parts:
            for row in range(part.varies != 'one' and part.name == 'gain', len(part.values)):
                for k, deviation in enumerate(part.deviations):
                    steps[f'{part.name}{row}' + (f'_{k}' if len(part.deviations) > 1 else '')] = 0.1 * deviation
        return steps

    def changed(self, numbers: dict[str, float]) -> Response:
        """A copy with other numbers, by name. Those that are missing are 0, and names of no part are passed over."""
        parts = [copy(part) for part in self.parts]
        for part in parts:
            part.values = _values(part, numbers)
            part.hold()
        return Response(self.geometry, parts)

    def doubts(self, numbers: dict[str, float], errors: dict[str, float]) -> dict[str, str]:
        """Return the names of the numbers that cannot be true, given their standard errors, each with the reason."""
        reasons = {}
        for part in self.changed(numbers).parts:
            if why := part.doubt(_values(part, errors)):
                reasons |= {name: why for name in self.names() if name.rstrip('0123456789_') == part.name}
        return reasons

    def report(self) -> dict[str, list[float]]:
        """Return the result in physical units for every view; a curve appears once."""
        values = {}
        for part, matrix in zip(self.parts, self._matrices(self.geometry)):
            values |= part.report(part.values if part.varies == 'one' else matrix @ part.values)
        return values

    def _step(self, p, m, inside, place, matrices):
        widths = [part.values.size for part in self.parts]
        starts = np.concatenate([[0], np.cumsum(widths)])
        H, g = np.zeros((starts[-1], starts[-1])), np.zeros(starts[-1])
        deviation = None
        for i in range(len(p)):
            numbers = [matrix[i] @ part.values for part, matrix in zip(self.parts, matrices)]
            x, columns = p[i], []
            for part, c in zip(self.parts, numbers):
                by_numbers, by_p = part.slopes(x, c, place)
                columns = [[by_p * a for a in slopes] for slopes in columns] + [by_numbers]
                x = part.apply(x, c, place)
            r = m[i] - x
            use = inside[i]
            if not use.any():
                continue
            if deviation is None:
                deviation = max(1.4826 * float(np.median(np.abs(r[use]))), 1e-6)
            weight = use * np.minimum(1, ROBUST * deviation / np.maximum(np.abs(r), 1e-12))
            # Derivatives by the view's own numbers, then by the numbers that these are made of.
            by_view = np.array([a.ravel() for slopes in columns for a in slopes])
            to = np.zeros((len(by_view), starts[-1]))
            k = 0
            for part, matrix, start, width in zip(self.parts, matrices, starts, widths):
                count = len(part.deviations)
                to[k : k + count, start : start + width] = np.kron(matrix[i][None], np.eye(count)).reshape(count, width)
                k += count
            weighted = by_view * weight.ravel()
            H += to.T @ (weighted @ by_view.T) @ to
            g += to.T @ (weighted @ r.ravel())
        if deviation is None:
            return
        flat = np.concatenate([part.values.ravel() for part in self.parts])
        prior = np.concatenate([np.tile((deviation / part.deviations) ** 2, len(part.values)) for part in self.parts])
        move = np.linalg.solve(H + np.diag(prior), g - prior * flat)
        for part, start, width in zip(self.parts, starts, widths):
            part.values = part.values + move[start : start + width].reshape(part.values.shape)
            part.hold()

    def _through(self, images, geometry, parts, what):
        out = np.empty(images.shape, np.float32)
        place, matrices = _place(images.shape[1:]), dict(zip(map(id, self.parts), self._matrices(geometry)))
        for i, image in enumerate(images):
            x = np.asarray(image, float)
            for part in parts:
                x = what(part)(x, matrices[id(part)][i] @ part.values, place)
            out[i] = x
        return out

    def _matrices(self, geometry):
        same_views = len(geometry) == len(self.geometry) and np.array_equal(geometry.angles, self.geometry.angles)
        if same_views:
            return self._in_time(np.linspace(-1, 1, len(geometry)), np.arange(len(geometry)))
        t = scan_times(self.geometry, geometry.angles)
        return self._in_time(t, np.clip((t + 1) / 2, 0, 1) * (len(self.geometry) - 1))

    def _in_time(self, t, index):
        """For each part the matrix [view, T] that makes a view's numbers of `values`; index: places among the scan's views."""
        n = len(self.geometry)
        matrices = []
        for part in self.parts:
            if part.varies == 'one':
                matrices.append(np.ones((len(t), 1)))
            elif part.varies == 'smooth':
                matrices.append(legendre.legvander(np.clip(t, -1, 1), len(part.values) - 1))
            else:  # between neighbours
                matrices.append(np.maximum(0, 1 - np.abs(np.asarray(index, float)[:, None] - np.arange(n))))
        return matrices


def _values(part, numbers):
    """The values [T, K] of a part, of numbers by name as `Response.names` has them; 0 for those that are missing."""
    values = np.zeros_like(part.values)
    for name, value in numbers.items():
        row, _, k = name.removeprefix(part.name).partition('_')
        if name.startswith(part.name) and row.isdigit():
            values[int(row), int(k or 0)] = value
    return values


def _place(shape):
    y, x = ((np.arange(n) + 0.5) / n * 2 - 1 for n in shape)
    return Place(*np.meshgrid(y, x, indexing='ij'))
