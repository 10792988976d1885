"""A fitted cloud, or the volume of a fitted field, and its scanner as a Mitsuba scene."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects
from lingo_mi.geometry.base import Geometry
from lingo_mi.scene.description import describe
from lingo_mi.storage.file_access import write_text
from lingo_mi.storage.output_folder import CLOUD, VOLUME


def write_scene(path: Path, geometry: Geometry, extent: float | None, effects: Effects | None = None) -> None:
    """Write a scene that renders what was fitted with the scan's own scanner. It needs only `import lingo_mi`.

    Parameters
    ----------
    extent : float or None
        Cut-off of the Gaussians in standard deviations; None: the scene is of the volume.
    effects : Effects or None
        The scan's effects that the fit has modelled. The scene then has their tube and a noise-free detector, so that it renders
        the images that the fit compared with the scan.
    """
    lines = [
        '<scene version="3.0.0">',
        *(_volume(geometry) if extent is None else _cloud(extent)),
        '    <sensor type="ct_scanner" id="scanner">',
    ]
    lines += _parameters(describe(geometry), 8)
    if effects is not None and effects.detector:
        parameters = {k: v for k, v in vars(effects.detector.expected).items() if v != Detector.DEFAULTS[k]}
        lines += ['        <film type="ct_detector">', *_parameters(parameters, 12), '        </film>']
    lines += ['    </sensor>']
    if effects is not None and effects.tube:
        spot = {}
        if effects.spot is not None:
            spot = dict(focal_spot='{:g}, {:g}'.format(*effects.spot.size), focal_order=effects.spot.order)
        parameters = {
            k: v
            for k, v in effects.tube.parameters.items()
            if not (v is None or k.startswith('material') or v == '' and k != 'filtration')
        }
        if effects.needs_materials:  # the cloud stands for all shapes
            parameters['material'] = ' + '.join(effects.tube.fitted())
        scatter = effects.scatter.within(geometry).parameters if effects.scatter else {}
        lines += [
            '    <emitter type="xray_tube" id="tube">',
            *_parameters(parameters | spot | scatter, 8),
            '    </emitter>',
        ]
    write_text(path, '\n'.join([*lines, '</scene>']) + '\n')


def _cloud(extent: float) -> list[str]:
    """The Gaussians, and an integrator with their cut-off."""
    return [
        '    <integrator type="lingo_xray">',
        f'        <float name="extent" value="{extent:g}"/>',
        '    </integrator>',
        '    <shape type="ellipsoids" id="cloud">',
        f'        <string name="filename" value="{CLOUD}"/>',
        '    </shape>',
    ]


def _volume(geometry: Geometry) -> list[str]:
    """The volume in a cube of the scanner's grid, and an integrator."""

    def placed(size, corner):
        scale, shift = (', '.join(f'{x:.9g}' for x in v) for v in (size, corner))
        return f'<transform name="to_world"><scale value="{scale}"/><translate value="{shift}"/></transform>'

    centre, size = np.array(geometry.grid.centre), np.array(geometry.grid.size)
    return [
        '    <integrator type="lingo_xray"/>',
        '    <shape type="cube" id="volume">',
        f'        {placed(size / 2, centre)}',
        '        <medium type="ct_volume" name="interior">',
        f'            <string name="filename" value="{VOLUME}"/>',
        f'            {placed(size, centre - size / 2)}',
        '        </medium>',
        '        <bsdf type="null"/>',
        '    </shape>',
    ]


def _parameters(values: dict, indent: int) -> list[str]:
    """Parameters of a plugin as lines of XML."""
    kinds = {str: 'string', float: 'float', int: 'integer'}
    return [
        ' ' * indent + f'<{kinds[type(v)]} name="{k}" value={quoteattr(v if isinstance(v, str) else repr(v))}/>'
        for k, v in values.items()
        if k != 'type'
    ]
