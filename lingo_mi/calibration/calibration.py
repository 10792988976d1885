"""A calibration: what was found of a scanner's errors, in sentences, and the scan without them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import overload

import numpy as np

from lingo_mi.calibration.response.response import Response
from lingo_mi.calibration.search import SearchResult
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.geometry.base import Geometry
from lingo_mi.inspection.air import Air, without_air
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.scan import Dataset, Scan

_TERMS = dict(
    air='air level',
    gain='gain over 1',
    curve='curve, coefficients from the square on',
    scatter='scatter over the open beam',
)


@dataclass(frozen=True)
class Calibration:
    """The result of `lm.calibrate`. `corrected` applies it to a scan.

    Parameters
    ----------
    geometry : Geometry
        The geometry of the scan before the calibration.
    found : SearchResult
        Numbers, their standard errors, and how well views predict each other before and after.
    air : Air or None
        The air level that was read beside the object and taken out first; None if none was.
    notes : tuple[str, ...]
        Sentences on what the scan does not determine.

    Examples
    --------
    ::

        calibration = lm.calibrate(data)
        print('\\n'.join(calibration.lines()))
        fit = lm.fit(calibration.corrected(data))
    """

    geometry: Geometry
    found: SearchResult
    air: Air | None = None
    notes: tuple[str, ...] = ()

    @property
    def needed(self) -> bool:
        """True if there is anything to correct."""
        drift = self.found.drift
        moved = any(drift.u) or any(drift.v) or bool(drift.yaw)
        return moved or self._response is not None or self.air is not None

    @property
    def _response(self) -> Response | None:
        """The response, if any of its numbers was found."""
        response = self.found.response
        return response if response is not None and any(part.values.any() for part in response.parts) else None

    @overload
    def corrected(self, scan: Scan) -> Scan: ...

    @overload
    def corrected(self, scan: Dataset) -> Dataset: ...

    def corrected(self, scan: Scan | Dataset) -> Scan | Dataset:
        """Apply the calibration to a scan.

        Held-out views get the correction for their time, which follows from their angles: the views of the scan must be in the
        order in which they were taken. An air level that was read beside the object is read again in each view.

        Parameters
        ----------
        scan : Scan or Dataset
            The views of the calibrated scan, or of other views by the same scanner.

        Returns
        -------
        Scan or Dataset
            The same views with the measured position of the panel, and without the response that was found.

        Raises
        ------
        InputError
            For a scan by another scanner.

        Examples
        --------
        `better = lm.calibrate(data).corrected(data)`
        """
        require_type('scan', scan, (Scan, Dataset))
        if isinstance(scan, Dataset):
            test = None if scan.test is None else self._moved(scan.test)
            return replace(scan, train=self._moved(scan.train), test=test)
        return self._moved(scan)

    def _moved(self, scan: Scan) -> Scan:
        if scan.geometry.mode != self.geometry.mode or scan.geometry.nDetector != self.geometry.nDetector:
            raise InputError('this calibration belongs to a scan by another scanner: calibrate this one')
        if not self.needed:
            return scan
        response = self._response
        if self.air is not None:
            scan = without_air(line_integrals(scan))
        if response is not None:
            scan = line_integrals(scan)  # the response was fitted to these
            scan = replace(scan, projections=response.undone(scan.projections, scan.geometry))
        return replace(scan, geometry=self.found.drift.panel(scan.geometry).moved(scan.geometry))

    def lines(self) -> list[str]:
        """Describe the result in sentences.

        Returns
        -------
        list[str]
            A line for each number with its standard error, how well views predict each other, and `notes`.

        Examples
        --------
        ::

            for line in lm.calibrate(scan).lines():
                print(line)
        """
        f, pixel = self.found, dict(zip('vu', self.geometry.dDetector))
        lines = []
        if self.air is not None:
            lines.append(
                f'air beside the object: {self.air.levels[:, 0].mean():+.3g} on average, and drifts by {self.air.drift:.2g} rms; '
                'taken out of every view'
            )
        for name, value in f.measured.items():
            error, why = f.errors[name], f.refused.get(name)
            if name == 'yaw':
                text = f'panel turned in its plane by {np.degrees(value):+.3f} degrees +- {np.degrees(error):.3f}'
            elif name[0] not in 'uv':
                text = f'{_TERMS[name.rstrip("0123456789_")]} ({name}): {value:+.3g} +- {error:.2g}'
            else:
                what = 'shift' if len(name) == 1 else f'drift of order {name[1:]}'
                pixels = value / pixel[name[0]]
                text = f'{what} of the panel along {name[0]}: {value:+.4g} mm +- {error:.2g} ({pixels:+.3f} pixels)'
            lines.append(text + (f', not taken: {why}' if why else ''))
        lines.append(
            f'views predict each other to {f.after:.4g} rms instead of {f.before:.4g} (line integrals, smoothed)'
        )
        return [*lines, *self.notes]
