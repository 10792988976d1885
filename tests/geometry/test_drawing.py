"""The drawing of a scanner: where its parts are, to scale."""

import re

import numpy as np
import pytest

from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.drawing import HEIGHT, PANEL, SOURCE, WIDTH, drawing
from lingo_mi.geometry.trajectories import circular

SCAN = dict(nDetector=(30, 40), dDetector=2.0, nVoxel=(20, 30, 10), dVoxel=2.0, offOrigin=(200.0, -100.0, 50.0))
ANGLES = circular(8)


def points(text):
    return np.array([float(x) for x in re.findall(r'-?[\d.]+', text)]).reshape(-1, 2)


def parts(geometry):
    """Parts of both drawings: sources [n, 2], corners of the panel [5, 2] and of the volume [4, 2], and rays [4, 2, 2]."""
    svg = drawing(geometry.rays(), geometry.nDetector, geometry.grid)
    lines = [
        (points(p), colour) for p, colour in re.findall(r'<polyline points="([^"]*)" fill="none" stroke="([^"]*)"', svg)
    ]
    dots = np.array(re.findall(rf'<circle cx="([^"]*)" cy="([^"]*)" r="2" fill="{SOURCE}"', svg), float)
    panels = [p for p, colour in lines if colour == PANEL]
    rays = [p for p, colour in lines if colour != PANEL]
    boxes = [points(p) for p in re.findall(r'<polygon points="([^"]*)"', svg)]
    return zip(np.split(dots, 2), panels, boxes, (rays[:4], rays[4:]))


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_parts_lie_on_the_canvas_and_are_to_scale(mode):
    geometry = (
        Geometry.cone(DSO=300, DSD=450, angles=ANGLES, **SCAN)
        if mode == 'cone'
        else Geometry.parallel(angles=ANGLES, **SCAN)
    )
    corner, u, v = geometry.rays().corner[0], 40 * geometry.rays().u[0], 30 * geometry.rays().v[0]
    panel = np.array([corner, corner + u, corner + u + v, corner + v])
    for i, (sources, drawn, box, rays) in enumerate(parts(geometry)):
        axes = [0, 1 + i]
        everything = np.concatenate([sources, drawn, box])
        assert (everything.min(0) >= [i * WIDTH, 14]).all() and (everything.max(0) <= [(i + 1) * WIDTH, HEIGHT]).all()
        across, up = np.ptp(box, axis=0)
        scale = across / 40  # pixels per mm
        assert up / scale == pytest.approx((60, 20)[i], abs=0.2 / scale)
        seen = panel[:, axes] * [scale, -scale]
        np.testing.assert_allclose(drawn[1:4] - drawn[0], seen[1:] - seen[0], atol=0.15)
        for begin, end in rays:
            if mode == 'cone':
                np.testing.assert_allclose(begin, sources[0])
            else:  # along the beam, from the plane that the dot stands for
                beam = geometry.rays().source[0][axes] * [1, -1]
                length = np.linalg.norm(beam)
                along, dot = (end - begin) @ beam, (drawn[0] + drawn[2]) / 2 - sources[0]
                if length > 0.1:
                    assert along / length == pytest.approx(dot @ beam / length, abs=1)
                    assert np.linalg.norm(end - begin) == pytest.approx(along / length, abs=1)
