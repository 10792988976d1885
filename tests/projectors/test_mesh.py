"""Path lengths through meshes, against closed forms in float64 at every pixel."""

import numpy as np
import pytest
import trimesh

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.rays import Rays
from lingo_mi.phantoms.mesh import Mesh, flange

use_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from lingo_mi.projectors.balance import SHARING  # noqa: E402
from lingo_mi.projectors.mesh import MeshPaths, from_mitsuba  # noqa: E402
from lingo_mi.projectors.view import View  # noqa: E402

SHAPE = 44, 61  # rows and columns, neither a multiple of what the kernel works on


def oblique(
    direction, distance=6.0, magnification=1.6, step=0.08, parallel=False, tilt=(0.0, 0.0), centre=(0.0, 0.0, 0.0)
):
    """One view of `centre`, along a direction, on a panel whose axes are neither square nor upright."""
    d = np.array(direction, float) / np.linalg.norm(direction)
    u = np.cross(d, [0.3, 0.2, 1.0])
    u /= np.linalg.norm(u)
    v = np.cross(d, u) + 0.15 * u
    u, v = step * (u + tilt[0] * d), step * (v + tilt[1] * d)
    middle = np.array(centre) + distance * (magnification - 1) * d
    corner = middle - u * SHAPE[1] / 2 - v * SHAPE[0] / 2
    source = d if parallel else np.array(centre) - distance * d
    return Rays(*(a[None] for a in (source, corner, u, v)), parallel)


def rays(frames):
    x, y = np.meshgrid(np.arange(SHAPE[1]) + 0.5, np.arange(SHAPE[0]) + 0.5)
    return frames.through(0, x, y)


def drawn(paths, frames):
    return paths.lengths(View.of(frames, 0, *SHAPE)).numpy().reshape(SHAPE)


def clipped(frames, points, normals, end=np.inf):
    """Chords of the convex body n . (r - p) <= 0."""
    o, d = rays(frames)
    low, high = np.full(SHAPE, -np.inf if frames.parallel else 0.0), np.full(SHAPE, end)
    for p, n in zip(points, normals):
        along, ahead = d @ n, (p - o) @ n
        with np.errstate(divide='ignore', invalid='ignore'):
            t = ahead / along
        high = np.where(along > 0, np.minimum(high, t), high)
        low = np.where(along < 0, np.maximum(low, t), low)
        high = np.where((along == 0) & (ahead < 0), -np.inf, high)
    return np.maximum(high - low, 0) * np.linalg.norm(d, axis=-1)


def convex(mesh, frames):
    return clipped(frames, mesh.triangles[:, 0], mesh.face_normals)


def paths_of(mesh):
    return MeshPaths(mesh.vertices, mesh.faces, 'part')


def close(image, expected, size, tolerance=1e-6):
    """Require equality at every pixel to a millionth of the mesh's size, and to 1e-5 where the chord is not short."""
    np.testing.assert_allclose(image, expected, rtol=0, atol=tolerance * size)
    long = expected > 0.1 * size
    assert long.any()
    np.testing.assert_allclose(image[long], expected[long], rtol=10 * tolerance)


VIEWS = {
    'cone': oblique((1, 0.31, -0.2)),
    'parallel': oblique((-0.4, 1, 0.7), parallel=True),
    'tilted': oblique((0.3, -0.8, 0.5), tilt=(0.4, -0.3)),
    'mirrored': oblique((1, 0.31, -0.2))[[0]],
    'tilted parallel': oblique((-0.4, 1, 0.7), parallel=True, tilt=(0.3, 0.5)),
    'close': oblique((1, 0.31, -0.2), distance=1.2, magnification=8, step=0.4),
}
# The other handedness: rows from bottom to top.
VIEWS['mirrored'].corner[0] += SHAPE[0] * VIEWS['mirrored'].v[0]
VIEWS['mirrored'].v[0] *= -1
BOX = trimesh.creation.box((1.1, 0.7, 1.6))
SPHERE = trimesh.creation.icosphere(2)


@pytest.mark.parametrize('name', VIEWS)
@pytest.mark.parametrize('mesh', [BOX, SPHERE], ids=['box', 'icosphere'])
def test_convex_bodies_at_every_pixel(mesh, name):
    close(drawn(paths_of(mesh), VIEWS[name]), convex(mesh, VIEWS[name]), 2)


def test_aligned_box_with_pixel_centres_on_its_edges(variant):
    half = np.array([7.5, 6.5, 4.5])
    paths = paths_of(trimesh.creation.box(2 * half))
    frames = Rays(*np.array([[[-1.0, 0, 0]], [[-20.0, -30.5, 22.0]], [[0.0, 1, 0]], [[0.0, 0, -1]]]), True)
    image = drawn(paths, frames)
    # Each crossing is divided by 1, which a GPU may do with an error of two units in the last place.
    exact = 4e-6 if variant.startswith('cuda') else 0
    assert np.all((image == 0) | (np.abs(image - 15) <= exact))
    assert (image > 0).sum() == 13 * 9


def test_pixel_centres_on_vertices_of_many_triangles():
    rng = np.random.default_rng(2)
    n = 20
    x, y = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n)))
    height = rng.uniform(1, 5, n * n)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    top = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    rim = np.concatenate(
        [
            np.arange(n),
            np.arange(2 * n - 1, n * n, n),
            np.arange(n * n - 2, n * n - n - 1, -1),
            np.arange(n * n - 2 * n, 0, -n),
        ]
    )
    following = np.roll(rim, -1)
    walls = np.concatenate(
        [np.stack([rim, rim + n * n, following + n * n], 1), np.stack([rim, following + n * n, following], 1)]
    )
    faces = np.concatenate([top, top[:, ::-1] + n * n, walls])
    vertices = np.concatenate([np.stack([x, y, height], 1), np.stack([x, y, -height], 1)])
    frames = Rays(*np.array([[[0.0, 0, 1]], [[-3.5, -4.5, -9.0]], [[1.0, 0, 0]], [[0.0, 1, 0]]]), True)
    image = drawn(MeshPaths(vertices, faces, 'relief'), frames)
    inside = image[5 : 5 + n - 2, 4 : 4 + n - 2]
    np.testing.assert_allclose(inside, 2 * height.reshape(n, n)[1:-1, 1:-1], rtol=1e-6)
    image[4 : 4 + n, 3 : 3 + n] = 0
    assert not image.any()


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_concave_part_with_holes(mode):
    geometry = CircularGeometry(
        DSO=900,
        DSD=1400,
        nDetector=SHAPE,
        dDetector=(8.0, 8.0),
        angles=[0.3, 2.0, 4.4],
        mode=mode,
        offDetector=(11.0, -7.0),
        grid=Grid((32,) * 3, (8.0,) * 3),
    )
    part = flange()
    paths, frames = paths_of(part), geometry.rays()
    for i, expected in enumerate(Mesh(part).project(geometry)):
        close(paths.lengths(View.of(frames, i, *SHAPE)).numpy().reshape(SHAPE), expected, 200)


def test_parts_and_cavities_add_up():
    frames = VIEWS['cone']
    other, hole = BOX.copy(), trimesh.creation.icosphere(1, 0.3)
    other.apply_translation((1.4, 0.3, 0.1))
    expected = convex(BOX, frames) + convex(other, frames) - convex(hole, frames)
    hole.invert()
    close(drawn(paths_of(trimesh.util.concatenate([BOX, other, hole])), frames), expected, 2)


def test_parts_that_share_an_edge():
    frames, boxes = VIEWS['cone'], [trimesh.creation.box((0.5, 0.5, 0.5)) for _ in range(2)]
    boxes[1].apply_translation((0.5, 0.5, 0))
    close(drawn(paths_of(trimesh.util.concatenate(boxes)), frames), sum(convex(b, frames) for b in boxes), 1)


@pytest.mark.parametrize('parallel', [False, True])
def test_far_from_the_origin(parallel):
    centre = 1e4 * np.array([1, -2, 1.5])
    mesh = BOX.copy()
    mesh.apply_translation(centre)
    frames = oblique((1, 0.31, -0.2), centre=centre, parallel=parallel)
    # The expected value itself is computed from coordinates of 1e4: only to 1e-11.
    close(drawn(paths_of(mesh), frames), convex(mesh, frames), 2)


def test_source_far_away():
    frames = oblique((1, 0.31, -0.2), distance=2e4, magnification=1.0001)
    close(drawn(paths_of(BOX), frames), convex(BOX, frames), 2)


def test_near_the_source_and_deep():
    # Depth varies by a factor of 9000, and the nearest corners lie far outside the image.
    points = np.array([[-5.999, -2, -2.0], [3, 2, 2]])
    mesh = trimesh.creation.box(bounds=points)
    frames = oblique((1, 0, 0))
    close(drawn(paths_of(mesh), frames), convex(mesh, frames), 10)


def test_triangles_much_smaller_than_pixels():
    mesh, frames = trimesh.creation.icosphere(5), oblique((0.2, 0.9, -0.4), step=0.2)
    image, expected = drawn(paths_of(mesh), frames), convex(mesh, frames)
    assert len(mesh.faces) > 50 * np.count_nonzero(expected)
    close(image, expected, 2)


def test_mesh_smaller_than_a_pixel_or_beside_the_image():
    mesh = BOX.copy()
    mesh.apply_scale(1e-3)
    mesh.apply_translation((0.3, 0.02, 0.01))
    assert not drawn(paths_of(mesh), VIEWS['cone']).any()
    mesh = BOX.copy()
    mesh.apply_translation((0, 0, 50))
    assert not drawn(paths_of(mesh), VIEWS['cone']).any()


def test_needles():
    mesh = trimesh.creation.icosphere(2)
    mesh.apply_transform(np.diag([1e-4, 1e-4, 1, 1]))
    direction = np.array((1, 0.31, -0.2))
    frames = oblique(direction, step=1e-5)
    close(drawn(paths_of(mesh), frames), convex(mesh, frames), 2e-4, 1e-4)


def test_inside_out_mesh_is_turned():
    mesh = BOX.copy()
    mesh.invert()
    np.testing.assert_array_equal(drawn(paths_of(mesh), VIEWS['cone']), drawn(paths_of(BOX), VIEWS['cone']))


def test_vertices_repeated_per_face():
    soup = MeshPaths(SPHERE.triangles.reshape(-1, 3), np.arange(3 * len(SPHERE.faces)).reshape(-1, 3), 'soup')
    np.testing.assert_allclose(drawn(soup, VIEWS['cone']), drawn(paths_of(SPHERE), VIEWS['cone']), atol=1e-6)


def test_mitsuba_meshes():
    transform = mi.ScalarTransform4f().translate([0.25, -0.5, 0.125]).rotate([0, 0, 1], 90).scale([-0.5, 0.25, 0.75])
    cube = mi.load_dict({'type': 'cube', 'to_world': transform})
    mesh = trimesh.creation.box((0.5, 1, 1.5))
    mesh.apply_translation((0.25, -0.5, 0.125))
    # The tolerance has room for Mitsuba's float32 vertices.
    close(drawn(from_mitsuba(cube), VIEWS['cone']), convex(mesh, VIEWS['cone']), 2)
    with pytest.raises(InputError, match='ball'):
        from_mitsuba(mi.load_dict({'type': 'scene', 'ball': {'type': 'sphere'}}).shapes()[0])


@pytest.mark.parametrize(
    'vertices, faces, message',
    [
        (BOX.vertices, BOX.faces[1:], '3 of its 18 edges'),
        (BOX.vertices, np.concatenate([BOX.faces[1:], BOX.faces[:1, ::-1]]), '3 of its 18 edges'),
        (BOX.vertices * np.nan, BOX.faces, 'finite'),
        (BOX.vertices, BOX.faces + 1, 'does not exist'),
        (BOX.vertices, BOX.faces[:0], 'at least one face'),
        (BOX.vertices[:, :2], BOX.faces, 'needs vertices'),
        (BOX.vertices * 0, BOX.faces, 'no extent'),
        *((BOX.vertices, np.array([face]), 'no extent') for face in ((0, 0, 1), (0, 1, 1), (1, 0, 1))),
    ],
)
def test_unusable_meshes(vertices, faces, message):
    with pytest.raises(InputError, match=f"'casting'.*{message}|{message}.*'casting'") as error:
        MeshPaths(vertices, faces, 'casting')
    assert '\n' not in str(error.value)


def test_mesh_across_source_and_panel():
    around = BOX.copy()
    around.apply_translation((-6, 0, 0))
    frames = oblique((1, 0, 0))
    with pytest.raises(InputError, match="'part'.*source"):
        drawn(paths_of(around), frames)
    around.apply_translation((9.6, 0, 0))
    close(drawn(paths_of(around), frames), convex(around, frames), 2)


def test_mesh_behind_the_source():
    mesh = BOX.copy()
    mesh.apply_translation((-9, 0, 0))
    assert not drawn(paths_of(mesh), oblique((1, 0, 0))).any()


def test_one_kernel_for_all_views_and_meshes():
    drawn(paths_of(SPHERE), VIEWS['cone'])
    box, views = paths_of(BOX), [VIEWS[k] for k in ('mirrored', 'close', 'cone')]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        for frames in views:
            drawn(box, frames)
        kernels = [k for k in dr.kernel_history() if k['type'] == dr.KernelType.JIT]
    assert kernels and all(k['cache_hit'] for k in kernels)


@pytest.mark.parametrize('level', [False, True])
def test_rows_past_a_triangle_write_nothing(level):
    """Teams walk eight rows at a time; those past a triangle's end, and maybe the image's, must have no packets."""
    from lingo_mi.projectors import mesh

    Float64 = dr.value_t(mi.Vector3d)
    zero, nan = Float64(0), Float64(np.nan)
    long, upper = (Float64(5.5), zero, zero, zero, zero), (Float64(9.5), zero, zero, zero, zero)
    lower = Float64(9.5), Float64(-1), zero, zero, zero
    if level:  # an upper edge along a row has no slope
        upper = *upper[:3], nan, nan
    first, last, *_ = mesh._row(long, lower, upper, mi.Int32(1), mi.Int32(0, 1, 7), mi.Int32(1), mi.Int32(20))
    step = SHARING.step
    packets = -(-last.numpy().astype(int) // step) - first.numpy().astype(int) // step
    assert np.all(packets[1:] <= 0) and (level or packets[0] == 2)
