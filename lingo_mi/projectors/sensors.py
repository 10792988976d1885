"""The rays of Mitsuba sensors as `view.View`, in float64, differentiable in their pose."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.errors import InputError
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.view import View


def views_of(sensor: Any) -> list[tuple[Any, View]]:
    """The sensors within a `mi.Sensor` and their rays: the sensors of a `batch` from left to right, or the sensor itself.

    Mitsuba gives each sensor of a batch a film of the size of its part.

    Raises
    ------
    InputError
        As `view_of`.
    """
    if sensor.class_name() != 'BatchSensor':
        return [(sensor, view_of(sensor))]
    members = [node for node in mi.traverse(sensor).hierarchy if isinstance(node, mi.Sensor) and node is not sensor]
    return [(member, view_of(member)) for member in members]


@full_float64()
def view_of(sensor: Any) -> View:
    """The rays through the pixel centres of the film of a flat `mi.Sensor`.

    Supports `ct_scanner`, `perspective` (with principal point offsets) and `orthographic`. Pixels belong to the film's crop
    window.

    Raises
    ------
    InputError
        For any other sensor.
    """
    if hasattr(sensor, 'frame'):
        return sensor.frame
    kind = str(sensor).split('[')[0]
    if kind not in ('PerspectiveCamera', 'OrthographicCamera'):
        raise InputError(
            f'lingo_xray cannot use the sensor {sensor.id()!r} ({kind}): '
            'it takes ct_scanner, perspective, orthographic and a batch of them'
        )
    film = sensor.film()
    params: Any = mi.traverse(sensor)
    (width, height), (crop_x, crop_y) = film.size(), film.crop_offset()
    (crop_width, crop_height) = film.crop_size()
    Vector3d = mi.Vector3d
    Float64 = dr.value_t(Vector3d)
    m = params['to_world'].matrix
    x_axis, y_axis, z_axis, origin = (Vector3d(*(Float64(m[i, j]) for i in range(3))) for j in range(4))
    # Mitsuba's cameras look along z with x to the left and y up; the image is 2 t wide at z = 1.
    if kind == 'PerspectiveCamera':
        t = dr.tan(Float64(params['x_fov']) * (0.5 * dr.pi / 180))
        shift_x, shift_y = Float64(params['principal_point_offset_x']), Float64(params['principal_point_offset_y'])
    else:
        t, shift_x, shift_y = Float64(1), Float64(0), Float64(0)
    u, v = x_axis * (-2 * t / width), y_axis * (-2 * t / width)
    left = width * (0.5 - shift_x) - crop_x
    top = height * (0.5 - shift_y) - crop_y
    centre = origin if kind == 'OrthographicCamera' else origin + z_axis
    corner = centre - left * u - top * v
    source = dr.normalize(z_axis) if kind == 'OrthographicCamera' else origin
    return View(source, corner, u, v, crop_width, crop_height, parallel=kind == 'OrthographicCamera')
