"""The sensor `ct_scanner`: a CT scanner with a flat panel, in TIGRE's terms."""
from dataclasses import fields

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.files import astra
from lingo_mi.files.poses import read_poses
from lingo_mi.files.scans import read_scan
from lingo_mi.files.tigre import to_posed
from lingo_mi.geometry import Geometry, circular, helix
from lingo_mi.runtime import data_file
from lingo_mi.xray.frame import View


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
       - The grid to reconstruct on, (x, y, z), and the voxel size in mm.
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
       - Roll, pitch and yaw of the panel about its centre in degrees, as in TIGRE: about the vertical, about u, and in its
         own plane. (Default: 0, 0, 0)
     * - poses
       - |string|
       - Instead of DSO, DSD, angles and the like, a pose for every view: 12 numbers each as in ASTRA (source or beam, centre
         of the panel, u, v), or a file of them, of projection matrices, or of RTK's geometry (see
         `lingo_mi.files.poses`), looked for like `projections`. A file that leaves the pixel size open needs dDetector.
     * - test_views
       - |int|
       - Views held out of the fit, at angles drawn uniformly from the same range with a fixed seed. (Default: 0)
     * - projections
       - |string|
       - A file of measured projections (see `lingo_mi.files.scans`), which then also gives the geometry. It is looked
         for beside the scene, then in the folder that LINGO_MI_DATA names. An empty name is none.
     * - view
       - |int|
       - The view that this sensor renders. (Default: 0)

    A nested film `ct_detector` says what the panel makes of the light: noise, blur, saturation and more.

    The source runs on a circle in the plane z = 0 unless told otherwise; `lingo_mi.geometry` states the frame, and
    `lingo_mi.frames.scanner_frames` what moves it. One view of a scanner is a
    sensor like any other: `mi.render(scene, sensor=scanner.view(7))`; `lingo_mi.scanning.scan` renders them all.
    """

    def __init__(self, props):
        self.dataset = None
        try:
            films = {name: thing for name, thing in props.objects() if isinstance(thing, mi.Film)}
            self.detector = next((f.detector for f in films.values() if hasattr(f, 'detector')), None)
            if len(films) > (self.detector is not None):
                raise InputError('the scanner makes its own film, of nDetector pixels: leave yours out, unless it is one '
                                 'ct_detector')
            projections = _one(props, 'projections', '')
            if projections:
                self.dataset = read_scan(data_file(projections, 'projections'))
                self.geometry = self.dataset.train.geometry
                self.test_geometry = self.dataset.test.geometry if self.dataset.test else None
            else:
                self.geometry, self.test_geometry = _read(props)
            self.index = _one(props, 'view', 0)
            if not 0 <= self.index < len(self.geometry):
                raise InputError(f'view {self.index} of a scan of {len(self.geometry)} views')
        except InputError as error:
            raise InputError(f'ct_scanner {props.id()!r}: {error}') from None
        for name in _NAMES:  # a file of projections overrides the numbers in the scene
            if name in props:
                props[name]
        for name in films:
            del props[name]
        props['film'] = mi.load_dict(film(*self.geometry.nDetector))
        super().__init__(props)
        frames = self.geometry.frames()
        self.frame = View.of(frames, self.index, *self.geometry.nDetector)
        # From where parallel rays start: well before the volume, wherever the panel is.
        self.back = 2 * float(np.linalg.norm(frames.corner[self.index]) + np.linalg.norm(self.geometry.offOrigin)
                              + np.linalg.norm(self.geometry.sVoxel))

    def view(self, index: int, geometry: Geometry | None = None) -> mi.Sensor:
        """The sensor of one view, of this scan or of another geometry, with the same detector."""
        sensor = mi.load_dict(describe(geometry or self.geometry, index))
        sensor.detector = self.detector
        return sensor

    def sample_ray(self, time, wavelength_sample, position_sample, aperture_sample, active=True):
        f = self.frame
        Vector3f = mi.Vector3f
        point = (Vector3f(f.corner) + Vector3f(f.u) * (position_sample.x * f.width)
                 + Vector3f(f.v) * (position_sample.y * f.height))
        if f.parallel:
            start, direction = point - Vector3f(f.source) * self.back, Vector3f(f.source)
        else:
            start, direction = mi.Point3f(f.source), dr.normalize(point - Vector3f(f.source))
        wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength_sample, active)
        return mi.Ray3f(mi.Point3f(start), direction, time, wavelengths), weight

    def sample_ray_differential(self, time, wavelength_sample, position_sample, aperture_sample, active=True):
        ray, weight = self.sample_ray(time, wavelength_sample, position_sample, aperture_sample, active)
        return mi.RayDifferential3f(ray), weight

    def bbox(self):
        return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(*np.array(self.frame.source).ravel()))

    def to_string(self):
        g = self.geometry
        way = f'DSO = {g.DSO:g}, DSD = {g.DSD:g}, offDetector = {g.offDetector}' if g.poses is None else 'a pose a view'
        return (f'CTScanner[\n  mode = {g.mode}, {way},\n  nDetector = {g.nDetector}, '
                f'dDetector = {g.dDetector},\n  nVoxel = {g.nVoxel}, '
                f'dVoxel = {g.dVoxel}, offOrigin = {g.offOrigin},\n  views = {len(g)}, view = {self.index}\n]')


create = CTScanner

MOST_VIEWS = 100_000
_NAMES = ('mode', 'DSO', 'DSD', 'nDetector', 'dDetector', 'offDetector', 'nVoxel', 'dVoxel', 'offOrigin', 'views',
          'totalAngle', 'startAngle', 'angles', 'test_views', 'pitch', 'tilt', 'rotDetector', 'poses')
_CIRCLE = ('DSO', 'DSD', 'offDetector', 'angles', 'views', 'totalAngle', 'startAngle', 'pitch', 'tilt', 'rotDetector',
           'test_views')


def film(rows: int, columns: int) -> dict:
    """A panel as Mitsuba film: the default one would blur pixels and store float16."""
    return dict(type='hdrfilm', width=columns, height=rows, rfilter=dict(type='box'), component_format='float32',
                pixel_format='luminance')


def describe(geometry: Geometry, index: int = 0) -> dict:
    """A `ct_scanner` as a dictionary for `mi.load_dict`."""
    def join(values):
        return ', '.join(repr(float(x)) if isinstance(x, float) else str(x) for x in values)
    g = geometry
    if g.poses is not None:
        vectors = astra.to_vectors(g.poses, g.nDetector)
        return dict(type='ct_scanner', mode=g.mode, nDetector=join(g.nDetector), nVoxel=join(g.nVoxel),
                    dVoxel=join(g.dVoxel), offOrigin=join(g.offOrigin), poses=join(vectors.ravel().tolist()), view=index)
    return dict(type='ct_scanner', mode=g.mode, DSO=g.DSO, DSD=g.DSD, nDetector=join(g.nDetector),
                dDetector=join(g.dDetector), offDetector=join(g.offDetector), nVoxel=join(g.nVoxel),
                dVoxel=join(g.dVoxel), offOrigin=join(g.offOrigin), angles=join(np.degrees(g.angles).tolist()),
                view=index)


def _one(props, name, default):
    """A property of the kind of its default: a string, a whole number or a finite number."""
    value = props.get(name, default)
    kind, wanted = {str: (str, 'text'), int: (int, 'a whole number'), float: ((int, float), 'a number')}[type(default)]
    if not isinstance(value, kind) or isinstance(value, bool) or (wanted == 'a number' and not np.isfinite(value)):
        raise InputError(f'{name} must be {wanted}, not {value!r}')
    return value


def _numbers(props, name, default=None):
    value = props.get(name, default)
    if value is None:
        raise InputError(f'{name} is missing')
    try:
        return [float(x) for x in str(value).replace(',', ' ').split()]
    except ValueError:
        raise InputError(f'{name} = {value!r} is not a list of numbers') from None


def _distance(props, name, default):
    values = _numbers(props, name, default)
    if len(values) != 1:
        raise InputError(f'{name} must be one number, not {values}')
    return values[0]


def _counts(props, name):
    values = _numbers(props, name)
    if any(n % 1 != 0 for n in values):  # also of NaN and infinity
        raise InputError(f'{name} must be whole numbers, not {values}')
    return values


def _read(props):
    """The scan's and the held-out views' geometry from a plugin's properties."""
    mode = _one(props, 'mode', 'cone')
    shared = dict(mode=mode, nDetector=_counts(props, 'nDetector'), nVoxel=_counts(props, 'nVoxel'),
                  dVoxel=_numbers(props, 'dVoxel'), offOrigin=_numbers(props, 'offOrigin', 0.))
    if _one(props, 'poses', ''):
        return _read_poses(props, shared), None
    total, start = _one(props, 'totalAngle', 360.), _one(props, 'startAngle', 0.)
    views, held_out = _one(props, 'views', 50), _one(props, 'test_views', 0)
    if held_out < 0:
        raise InputError(f'test_views must not be negative, but is {held_out}')
    if max(views, held_out) > MOST_VIEWS:
        raise InputError(f'a scan has at most {MOST_VIEWS} views, not {max(views, held_out)}')
    angles = np.radians(_numbers(props, 'angles')) if 'angles' in props else circular(views, total, start)
    far = 1. if mode == 'parallel' else None  # a parallel beam has no source; the distances only place it
    shared |= dict(DSO=_distance(props, 'DSO', far), DSD=_distance(props, 'DSD', far),
                   dDetector=_numbers(props, 'dDetector'), offDetector=_numbers(props, 'offDetector', 0.))
    pitch, tilt, turned = _one(props, 'pitch', 0.), _one(props, 'tilt', 0.), _numbers(props, 'rotDetector', '0 0 0')
    if len(turned) != 3:
        raise InputError(f'rotDetector must be 3 angles (roll, pitch, yaw), not {turned}')

    def geometry(at):
        circle = Geometry(angles=at, **shared)
        if not (pitch or tilt or any(turned)):
            return circle
        plain = {f.name: getattr(circle, f.name) for f in fields(circle) if f.name != 'poses'}
        return Geometry.per_view(**plain, height=helix(at, pitch), tilt=np.radians(tilt), rotDetector=np.radians(turned))
    if not held_out:
        return geometry(angles), None
    drawn = np.sort(total * np.random.default_rng(0).uniform(0, 1, held_out)) + start
    return geometry(angles), geometry(np.radians(drawn))


def _read_poses(props, shared):
    """A scan with a pose for every view."""
    given = [name for name in _CIRCLE if name in props]
    if given:
        raise InputError(f'{given[0]} and poses both say which views there are; leave one of them out')
    known = {k: v for k, v in shared.items() if k != 'mode'}
    known |= {'dDetector': _numbers(props, 'dDetector')} if 'dDetector' in props else {}

    def frames(n_detector, step, parallel, origin):
        poses = props['poses']
        try:
            numbers = [float(x) for x in poses.replace(',', ' ').split()]
        except ValueError:
            return read_poses(data_file(poses, 'poses'), n_detector, step, parallel, origin)
        if len(numbers) % 12:
            raise InputError(f'poses must be 12 numbers for every view, not {len(numbers)}')
        return astra.from_vectors(np.reshape(numbers, (-1, 12)), n_detector, parallel)
    return to_posed(known | {'mode': shared['mode']}, frames, 'poses')
