"""The sensor `ct_scanner`: a CT scanner with a flat or a curved panel, in TIGRE's terms."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan
from lingo_mi.geometry import CircularGeometry, CurvedGeometry, Geometry
from lingo_mi.projectors.view import View
from lingo_mi.scan import Dataset
from lingo_mi.scene.data_files import data_file
from lingo_mi.scene.description import NAMES, describe, grid_from, parameter, read_scanner


class CTScanner(mi.Sensor):
    r"""
    .. _sensor-ct_scanner:

    CT scanner (:monosp:`ct_scanner`)
    ---------------------------------

    .. pluginparameters::

     * - mode
       - |string|
       - `cone` or `parallel`. (Default: cone)
     * - DSO, DSD
       - |float|
       - Distances from the source to the rotation axis and to the panel, mm.
     * - nDetector, dDetector
       - |string|
       - Pixels and pixel size in mm, rows then columns: "512, 512". One number stands for both.
     * - offDetector
       - |string|
       - Shift of the panel in mm, (v, u), positive v towards +z. (Default: 0)
     * - nVoxel, dVoxel
       - |string|
       - The grid to reconstruct on, (x, y, z), and the voxel size in mm. With `projections`: in place of the file's own,
         unless the file holds a true volume.
     * - offOrigin
       - |string|
       - Centre of that grid in mm. (Default: 0)
     * - views, totalAngle, startAngle
       - |int|, |float|, |float|
       - Evenly spaced views, degrees, the end excluded. (Default: 50, 360, 0)
     * - angles
       - |string|
       - Instead: every view's angle in degrees.
     * - pitch
       - |float|
       - A helix: mm that source and panel climb along z in a turn, past z = 0 at the angle 0. Two turns around the
         middle are startAngle -360 and totalAngle 720. (Default: 0)
     * - tilt
       - |float|
       - Laminography: degrees by which the source is lifted out of the plane of rotation, the panel sunk. (Default: 0)
     * - rotDetector
       - |string|
       - Turns of the panel about its centre in degrees: about the vertical, about u, and in its own plane. TIGRE has the same
         three in radians and in the opposite order. (Default: 0, 0, 0)
     * - poses
       - |string|
       - Instead of DSO, DSD, angles and the like, a pose for every view: 12 numbers each as in ASTRA (source or beam, centre
         of the panel, u, v), or a file of them, of projection matrices, or of RTK's geometry (see
         `lingo_mi.files.poses`), looked for like `projections`. A file that leaves the pixel size open needs dDetector.
     * - radius
       - |float|
       - Of a panel that is bent on a cylinder, mm: DSD where its axis passes through the focal spot. dDetector is then a pixel's
         height and width along the arc; `poses` say where the panel's middle is. Not for meshes, nor with a tube, a
         detector or n x n rays a pixel. (Default: 0, a flat panel)
     * - test_views
       - |int|
       - Views held out of the fit, at angles drawn uniformly from the same range, or between the
         least and the largest of `angles`, with a fixed seed. (Default: 0)
     * - projections
       - |string|
       - A file of measured projections (see `lingo_mi.files.scans`), which then also gives the geometry. It is looked
         for beside the scene, then in the folder that LINGO_MI_DATA names. An empty name is none.
     * - view
       - |int|
       - The view that this sensor renders. (Default: 0)

    A nested film `ct_detector` says what the panel makes of the light: noise, blur, saturation and more.

    The source runs on a circle in the plane z = 0 unless told otherwise; `lingo_mi.geometry.base` states the frame, and
    `lingo_mi.geometry.trajectories.scanner_rays` what moves it. One view of a scanner is a
    sensor like any other: `mi.render(scene, sensor=scanner.view(7))`; `lingo_mi.scene.simulate.take_scan` renders them all.
    """

    def __init__(self, props):
        self.dataset = None
        try:
            films: dict[str, Any] = {name: obj for name, obj in props.objects() if isinstance(obj, mi.Film)}
            self.detector = next((f.detector for f in films.values() if hasattr(f, 'detector')), None)
            if len(films) > (self.detector is not None):
                raise InputError(
                    'the scanner makes its own film, of nDetector pixels: leave yours out, unless it is a ct_detector'
                )
            projections = parameter(props, 'projections', '')
            if projections:
                self.dataset = self._measured(projections, props)
                self.geometry = self.dataset.train.geometry
                self.test_geometry = self.dataset.test.geometry if self.dataset.test else None
            else:
                self.geometry, self.test_geometry = read_scanner(props)
            self.index = parameter(props, 'view', 0)
            if not 0 <= self.index < len(self.geometry):
                raise InputError(f'view {self.index} of a scan of {len(self.geometry)} views')
        except InputError as error:
            raise InputError(f'ct_scanner {props.id()!r}: {error}') from None
        for name in NAMES:  # a file of projections overrides the numbers in the scene
            if name in props:
                props[name]
        for name in films:
            del props[name]
        props['film'] = mi.load_dict(film(*self.geometry.nDetector))
        super().__init__(props)
        self.rays = self.geometry.rays(curved=True)[[self.index]]
        self.panel = View.of(self.rays, 0, *self.geometry.nDetector)
        # From where parallel rays start: well before the volume, wherever the panel is.
        self.back = 2 * float(
            np.linalg.norm(self.rays.corner)
            + np.linalg.norm(self.geometry.grid.centre)
            + np.linalg.norm(self.geometry.grid.size)
        )

    @staticmethod
    def _measured(name, props):
        """A file of projections, on the voxels that the scene names."""
        dataset = read_scan(data_file(name, 'projections'))
        if dataset.volume is not None:  # the true one, on the file's own voxels
            return dataset

        def on_grid(scan):
            return scan.on(grid_from(props, scan.geometry.grid))

        return Dataset(on_grid(dataset.train), dataset.test and on_grid(dataset.test))

    @property
    def frame(self) -> View:
        """The rays through the film's crop window, the whole panel unless `mi.traverse` changed it.

        Raises InputError if the film has other pixels than the panel.
        """
        film, panel = self.film(), self.panel
        if (film.size()[0], film.size()[1]) != (panel.width, panel.height):
            raise InputError(
                f'ct_scanner {self.id()!r}: the film has {film.size()[0]} x {film.size()[1]} pixels, the panel '
                f'{panel.width} x {panel.height}: change nDetector instead, or give a batch of n scanners a film of n '
                f'times {panel.width} x {panel.height}'
            )
        (x, y), (width, height) = film.crop_offset(), film.crop_size()
        if (width, height) == (panel.width, panel.height):
            return panel
        return View.of(self.rays.cropped(x, y), 0, height, width)

    def view(self, index: int, geometry: Geometry | None = None) -> mi.Sensor:
        """The sensor of one view, of this scan or of another geometry, with the same detector."""
        sensor = mi.load_dict(describe(geometry or self.geometry, index))
        sensor.detector = self.detector
        return sensor

    def sample_ray(
        self,
        time: Any,
        wavelength_sample: Any,
        position_sample: mi.Point2f,
        aperture_sample: mi.Point2f,
        active: Any = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        f = self.frame
        Vector3f = mi.Vector3f
        x, y = position_sample.x * f.width, position_sample.y * f.height
        if f.bend is not None:
            x, y = f.bend.position(x, y)
        point = Vector3f(f.corner) + Vector3f(f.u) * x + Vector3f(f.v) * y
        if f.parallel:
            start, direction = point - Vector3f(f.source) * self.back, Vector3f(f.source)
        else:
            start, direction = mi.Point3f(f.source), dr.normalize(point - Vector3f(f.source))
        wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength_sample, active)
        return mi.Ray3f(mi.Point3f(start), direction, time, wavelengths), weight

    def sample_ray_differential(
        self,
        time: Any,
        wavelength_sample: Any,
        position_sample: mi.Point2f,
        aperture_sample: mi.Point2f,
        active: Any = True,
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        ray, weight = self.sample_ray(time, wavelength_sample, position_sample, aperture_sample, active)
        return mi.RayDifferential3f(ray), weight

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(*np.array(self.panel.source).ravel()))

    def to_string(self) -> str:
        g = self.geometry
        circle = isinstance(g, CircularGeometry)
        bend = f'radius = {g.radius:g}, ' if isinstance(g, CurvedGeometry) else ''
        way = f'DSO = {g.DSO:g}, DSD = {g.DSD:g}, offDetector = {g.offDetector}' if circle else 'a pose a view'
        return (
            f'CTScanner[\n  mode = {g.mode}, {bend}{way},\n  nDetector = {g.nDetector}, '
            f'dDetector = {g.dDetector},\n  nVoxel = {g.grid.shape}, '
            f'dVoxel = {g.grid.spacing}, offOrigin = {g.grid.centre},\n  views = {len(g)}, view = {self.index}\n]'
        )


def film(rows: int, columns: int) -> dict:
    """A panel as Mitsuba film: the default one would blur pixels and store float16."""
    return dict(
        type='hdrfilm',
        width=columns,
        height=rows,
        rfilter=dict(type='box'),
        component_format='float32',
        pixel_format='luminance',
    )


create = CTScanner
