"""Errors of the measurement that are fitted together with the cloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lingo_mi.calibration.response.part import VARIES
from lingo_mi.fitting.options.part import Part, require


@dataclass(frozen=True)
class Corrections(Part):
    """Corrections that are fitted with the cloud. All are off by default.

    The angles of the views give their time, so the views must be in the order in which they were taken. A curve and scattered
    light, which a cloud would absorb, are found before a fit: `lm.calibrate`.

    Parameters
    ----------
    rate_pose : tuple of float
        Adam's step sizes (first, last) for the poses of the views: radians, and units of half the volume's longest side;
        (0, 0): poses stay as they are.
    pose_motion : {'view', 'smooth'}
        'view' corrects every view for itself. 'smooth' fits cubic polynomials in time, which held-out views get, too.
    fit_air : {'off', 'smooth', 'view'}
        Air level of the views: a cubic polynomial in time, or every view for itself.
    fit_gain : {'off', 'smooth', 'view'}
        Gain of the views, likewise.
    fit_pixels : {'off', 'one'}
        'one' fits what each pixel adds to its line integrals in all views: gains that the flat fields missed.

    Examples
    --------
    `lm.fit(scan, lm.Fast().changed(rate_pose=(1e-3, 1e-4), pose_motion='smooth'))`
    """

    RANGES: ClassVar = dict(rate_pose=(0, 1))
    CHOICES: ClassVar = dict(pose_motion=('view', 'smooth'), fit_air=VARIES, fit_gain=VARIES, fit_pixels=('off', 'one'))

    rate_pose: tuple[float, float] = (0.0, 0.0)
    pose_motion: str = 'view'
    fit_air: str = 'off'
    fit_gain: str = 'off'
    fit_pixels: str = 'off'

    def __post_init__(self):
        super().__post_init__()
        require(
            min(self.rate_pose) > 0 or self.rate_pose == (0, 0),
            f'rate_pose must be two positive numbers, first and last, or 0, not {self.rate_pose}',
        )

    @property
    def moves_views(self) -> bool:
        """True if poses are corrected."""
        return max(self.rate_pose) > 0

    @property
    def responds(self) -> bool:
        """True if a response of the detector is fitted."""
        return any(x != 'off' for x in (self.fit_air, self.fit_gain, self.fit_pixels))
