"""The emitter `ct_beam`: the X-rays of one view as light for Mitsuba's own integrators."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.view import View


class CTBeam(mi.Emitter):
    r"""
    .. _emitter-ct_beam:

    Beam of one view (:monosp:`ct_beam`)
    ------------------------------------

    A point source of intensity 1, or parallel rays of irradiance 1, collimated to a panel: only points between source and panel
    are lit, which is what a scanner's collimator does. It has no parameters; `aim` points it at a view.

    `lingo_mi.effects.scatter` puts it into the scenes whose scattered light it computes.
    """

    def __init__(self, props):
        super().__init__(props)
        self.m_flags = mi.EmitterFlags.DeltaPosition

    def aim(self, view: View, reach: float) -> None:
        """Shine at the panel of a `lingo_mi.projectors.view.View`. reach: from how far parallel rays come to what they light."""
        self.reach: Any = dr.opaque(mi.Float, reach)
        across = dr.cross(view.u, view.v)
        self.parallel, self.size = view.parallel, dr.opaque(mi.Vector2f, (view.width, view.height))
        self.source, self.corner = mi.Vector3f(view.source), mi.Vector3f(view.corner)
        self.normal = mi.Vector3f(dr.normalize(across))
        # x and y of a point of the panel in pixels are its products with these.
        self.x = mi.Vector3f(dr.cross(view.v, across) / dr.squared_norm(across))
        self.y = mi.Vector3f(dr.cross(across, view.u) / dr.squared_norm(across))
        dr.make_opaque(self.source, self.corner, self.normal, self.x, self.y)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool | bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        p = mi.Vector3f(it.p)
        along = self.source if self.parallel else p - self.source
        behind = dr.dot(self.normal, self.corner - p) / dr.dot(self.normal, along)
        at = p + behind * along - self.corner
        x, y = dr.dot(self.x, at), dr.dot(self.y, at)
        lit = active & (behind >= 0) & (x >= 0) & (x <= self.size.x) & (y >= 0) & (y <= self.size.y)
        ds: Any = dr.zeros(mi.DirectionSample3f)
        distance = dr.norm(along)
        ds.dist = self.reach if self.parallel else distance
        ds.d = -along / distance
        ds.p = mi.Point3f(p + ds.dist * ds.d)
        ds.n, ds.time, ds.pdf, ds.delta = -ds.d, it.time, mi.Float(1), mi.Bool(True)
        ds.emitter = mi.EmitterPtr(self)
        return ds, mi.Spectrum(dr.select(lit, 1 if self.parallel else dr.rcp(dr.square(distance)), 0))

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Spectrum:
        return mi.Spectrum(0)

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool | bool = True) -> mi.Float:
        return mi.Float(0)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool | bool = True
    ) -> mi.Spectrum:
        return mi.Spectrum(0)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        pass

    def to_string(self) -> str:
        return 'CTBeam[]'


create = CTBeam
