"""The unattenuated beam: what the panel shows without an object, and the air level of every view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.raw.line_integrals import Fields, fields
from lingo_mi.raw.options import Options, region_of
from lingo_mi.raw.recording import Frames


@dataclass(frozen=True)
class Beam:
    """Reference of line integrals: the open beam.

    Parameters
    ----------
    panel : Fields
        Fields of the whole frame.
    i0 : float or None
        Counts of the beam, if they are given, as an option or as Nikon's white level.
    air : tuple[int, int, int, int] or None
        (v0, v1, u0, u1): pixels whose mean is the air level of a view.
    percentile : float or None
        Percentile of a view's pixels that is its air level, in place of `air`.
    limit : float
        Counts from here on are not valid.
    """

    panel: Fields
    i0: float | None
    air: tuple[int, int, int, int] | None
    percentile: float | None
    limit: float

    @classmethod
    def of(
        cls,
        path: PathLike | str,
        options: Options,
        views: Frames,
        flats: Frames | None,
        darks: Frames | None,
        white: float | None,
    ) -> Beam:
        """Make the beam that the options ask for. `path` is named in errors; `white` is Nikon's white level.

        Raises
        ------
        InputError
            If nothing says the beam, or more than one thing does.
        """
        without_air = options.air is None and options.percentile is None
        if options.i0 is not None or flats is not None or not without_air:
            white = None  # not needed
        i0 = options.i0 if white is None else white
        if sum(x is not None for x in (options.air, options.percentile, i0)) > 1:
            raise InputError('air, percentile and i0 all say the air level; give one of them')
        if flats is None and i0 is None and without_air:
            raise InputError(
                f'{path}: there are no flat frames; give flats=FILE, or the air level: air=(v0, v1, u0, u1), a region without '
                'object, percentile=P, or i0=COUNTS'
            )
        if i0 is not None and not i0 > 0:
            raise InputError(f'i0 must be positive, not {i0:g}')
        if options.percentile is not None and not 0 < options.percentile <= 100:
            raise InputError(f'the percentile of air must be above 0 and at most 100, not {options.percentile:g}')
        if flats is not None and i0 is not None:
            raise InputError('flats and i0 both say the unattenuated beam; give one of them')
        air = region_of('air', options.air, views.shape)
        limit = _largest(views) if options.saturation is None else options.saturation
        brightest = limit if options.saturation is not None or flats is None else _largest(flats)
        panel = fields(views.shape, flats, darks, brightest)
        if flats is None and i0 is not None:
            # Nikon's white level is a count, with the dark signal in it.
            panel = replace(panel, flat=np.full(views.shape, float(i0)) if white is None else i0 - panel.dark)
        return cls(panel, i0, air, options.percentile, limit)

    def level(self, frame: np.ndarray, exposure: float) -> float:
        """The air level of a whole frame, over what the panel shows at this exposure; 1 if the beam is known otherwise, and
        NaN without a good pixel."""
        if self.air is None and self.percentile is None:
            return 1.0
        good = self.panel.good & np.isfinite(frame) & (frame < self.limit)
        counts = frame - self.panel.dark
        reference = np.full(frame.shape, exposure) if self.panel.flat is None else self.panel.flat * exposure
        if self.air is not None:
            v0, v1, u0, u1 = self.air
            inside = np.zeros(frame.shape, bool)
            inside[v0:v1, u0:u1] = True
            good &= inside
        if not good.any():
            return np.nan
        counts, reference = counts[good], reference[good]
        if self.percentile is None:
            return float(counts.sum() / reference.sum())
        return float(np.percentile(counts / reference, self.percentile))


def _largest(frames: Frames) -> float:
    """The largest count that their type can hold."""
    return np.iinfo(frames.dtype).max if frames.dtype.kind in 'ui' else np.inf
