"""Helpers of tests of fits with effects."""

import mitsuba as mi
import numpy as np

from helpers.fits import SHORT, geometry, some_points, tiny_scan
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.hardening import Tube, TubeParameters
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.state import start
from lingo_mi.scan import Scan
from lingo_mi.scene.load import load_scene


def tube(material='soft tissue', split=''):
    return Tube.of(TubeParameters(kvp=120.0, material=material, split=split))


def detector(**changes):
    return Detector.of(**{**Detector.DEFAULTS, **changes})


def stepper_of(effects, views=3, **changes):
    """A stepper of a scan with effects, and a cloud for it, in the fit's unit."""
    g = geometry(views)
    # Line integrals of order one; the measured views lie above the rendered ones everywhere, for differences of L1.
    scan = Scan(g, tiny_scan(g).projections / 50 + 3, effects=effects)
    stepper, points = SHORT.changed(extent=7, **changes).stepper(scan), some_points(g, 40)
    return stepper, DeviceState(start(points.points, points.spacing * 2, points.density * 0.1, stepper.forward))


def rendered_from_files(stepper, state, effects, folder):
    """The stepper's views by Mitsuba's integrator, from the scene and the cloud that a fit writes."""
    from lingo_mi.files.ply import write_ply
    from lingo_mi.fitting.scene_file import write_scene
    from lingo_mi.fitting.state import activate

    g, share = stepper.geometry, stepper.model.shares(state)
    centre, scale, rotation, density = activate(state.host(), stepper.forward)
    write_ply(
        folder / 'gaussians.ply',
        centre / g.grid.scale,
        scale / g.grid.scale,
        rotation,
        density * stepper.model.unit,
        None if share is None else share.numpy(),
    )
    write_scene(folder / 'result.xml', g, 7, effects)
    loaded = load_scene(folder / 'result.xml')
    return [np.array(mi.render(loaded.scene, sensor=loaded.scanner.view(i)))[..., 0] for i in range(len(g))]
