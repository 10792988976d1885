"""The Gaussian cloud in PLY: round trip, Mitsuba's reading of it, and bad input."""

import mitsuba as mi
import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files.ply import read_ply, require_elements, write_ply


def cloud(n=5):
    rng = np.random.default_rng(3)
    q = rng.normal(size=(n, 4))
    return (
        rng.normal(size=(n, 3)),
        np.exp(rng.normal(size=(n, 3)) - 2),
        q / np.linalg.norm(q, axis=1, keepdims=True),
        rng.random(n),
    )


def test_round_trip(tmp_path):
    path = tmp_path / 'a.ply'
    write_ply(path, *cloud())
    for a, b in zip(read_ply(path), cloud()):
        assert a.dtype == np.float32 and a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=2e-6)
    assert [p.name for p in tmp_path.iterdir()] == ['a.ply']


def test_quaternions_are_normalised_and_density_may_be_a_column(tmp_path):
    centres, scales, q, density = cloud()
    write_ply(tmp_path / 'a.ply', centres, scales, 7 * q, density[:, None])
    np.testing.assert_allclose(read_ply(tmp_path / 'a.ply')[2], q, rtol=1e-6)


def test_remarks_in_the_header_are_passed_over(tmp_path):
    path = tmp_path / 'a.ply'
    write_ply(path, *cloud())
    raw = path.read_bytes()
    path.write_bytes(raw.replace(b'element', b'obj_info by hand\ncomment property x\nelement', 1))
    np.testing.assert_allclose(read_ply(path)[0], cloud()[0], rtol=2e-6)


def test_mitsuba_reads_the_same_cloud(tmp_path):
    path = tmp_path / 'a.ply'
    write_ply(path, *cloud())
    params = mi.traverse(mi.load_dict({'type': 'ellipsoids', 'filename': str(path)}))
    centres, scales, q, density = cloud()
    data = np.array(params['data']).reshape(-1, 10)
    np.testing.assert_allclose(data, np.concatenate([centres, scales, q], 1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.array(params['density']), density, rtol=1e-6)
    assert 'opacities' not in params  # would mean that it was taken for a 3DGS file


def test_viewers_opacity_is_that_of_the_ray_through_the_centre(tmp_path):
    path = tmp_path / 'a.ply'
    write_ply(path, [[0, 0, 0]] * 2, [[0.1, 0.1, 0.1]] * 2, [[0, 0, 0, 1]] * 2, [3.0, 1e9])
    raw = path.read_bytes()
    rows = np.frombuffer(raw[raw.index(b'end_header\n') + 11 :], '<f4').reshape(2, -1)
    names = [line.split()[-1] for line in raw[: raw.index(b'end_header')].decode().splitlines() if 'property' in line]
    alpha = 1 / (1 + np.exp(-rows[:, names.index('opacity')]))
    assert alpha[0] == pytest.approx(1 - np.exp(-3 * np.sqrt(2 * np.pi) * 0.1), rel=1e-5)
    assert 0.99 < alpha[1] < 1
    assert names[6:11] == ['f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', 'density']


def refused(path, match):
    with pytest.raises(InputError, match=match) as caught:
        read_ply(path)
    assert '\n' not in str(caught.value) and str(path) in str(caught.value)


def edited(tmp_path, old=b'', new=b'', cut=None):
    path = tmp_path / 'a.ply'
    write_ply(path, *cloud())
    path.write_bytes(path.read_bytes().replace(old, new, 1)[:cut])
    return path


@pytest.mark.parametrize(
    'old, new, cut, match',
    [
        (b'', b'', -1, 'truncated'),
        (b'', b'', 30, 'no end'),
        (b'', b'', 0, 'not a PLY'),
        (b'ply', b'PNG', None, 'not a PLY'),
        (b'little', b'big', None, 'binary_little_endian'),
        (b'binary_little_endian', b'ascii', None, 'binary_little_endian'),
        (b'float density', b'float mass', None, 'no property density'),
        (b'float density', b'float opacity', None, 'repeated'),
        (b'float density', b'half density', None, 'unknown types'),
        (b'vertex 5', b'vertex 0', None, 'truncated'),
        (b'vertex 5', b'vertex x', None, "element 'vertex'"),
        (b'vertex 5', b'face 5', None, "element 'vertex'"),
        (b'end_header', b'element face 0\nend_header', None, "element 'vertex'"),
        (b'end_header', 2000 * b'comment\n' + b'end_header', None, 'no end'),
    ],
)
def test_damaged_files(tmp_path, old, new, cut, match):
    refused(edited(tmp_path, old, new, cut), match)


def test_properties_of_other_types_and_order(tmp_path):
    path = tmp_path / 'a.ply'
    names = ['rot_3', 'rot_2', 'rot_1', 'rot_0', 'density', 'scale_2', 'scale_1', 'scale_0', 'z', 'y', 'x']
    header = (
        'ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex 1\nproperty uchar red\n'
        + ''.join(f'property double {n}\n' for n in names)
        + 'end_header\n'
    )
    row = np.array([1.0, 0, 0, 0, 5, 0, np.log(2), np.log(3), 30, 20, 10], '<f8')
    path.write_bytes(header.encode() + b'\xff' + row.tobytes())
    centres, scales, q, density = read_ply(path)
    np.testing.assert_allclose(
        [*centres[0], *scales[0], *q[0], density[0]], [10, 20, 30, 3, 2, 1, 0, 0, 1, 0, 5], rtol=1e-6
    )


TYPES = {  # as the format has them, and as other programs write them
    'i1': ('char', 'int8'),
    'u1': ('uchar', 'uint8'),
    '<i2': ('short', 'int16'),
    '<u2': ('ushort', 'uint16'),
    '<i4': ('int', 'int32'),
    '<u4': ('uint', 'uint32'),
    '<f4': ('float', 'float32'),
    '<f8': ('double', 'float64'),
}


@pytest.mark.parametrize('dtype', TYPES)
def test_types(tmp_path, dtype):
    path, names = tmp_path / 'a.ply', ('x', 'y', 'z', 'density', *(f'scale_{i}' for i in range(3)))
    for kind in TYPES[dtype]:
        header = 'ply\nformat binary_little_endian 1.0\nelement vertex 1\n'
        header += ''.join(f'property {kind} {n}\n' for n in names)
        header += ''.join(f'property float rot_{i}\n' for i in range(4)) + 'end_header\n'
        body = np.array([10, 20, 100, 5, 0, 1, 2], dtype).tobytes() + np.array([1, 0, 0, 0], '<f4').tobytes()
        path.write_bytes(header.encode() + body)
        require_elements(path)
        centres, scales, _, density = read_ply(path)
        np.testing.assert_allclose([*centres[0], density[0], *scales[0]], [10, 20, 100, 5, *np.exp([0, 1, 2])])
        path.write_bytes(header.encode() + body[:-1])
        with pytest.raises(InputError, match='announces more'):
            require_elements(path)


def test_values_in_the_file_are_checked(tmp_path):
    path = tmp_path / 'a.ply'
    write_ply(path, *cloud())
    raw = path.read_bytes()
    for offset, value, match in ((0, np.nan, 'centres'), (11 * 4, 200.0, 'scales'), (10 * 4, np.inf, 'density')):
        start = raw.index(b'end_header\n') + 11 + offset
        path.write_bytes(raw[:start] + np.float32(value).tobytes() + raw[start + 4 :])
        refused(path, f'{match} of Gaussian 0 is not finite')


def test_missing(tmp_path):
    refused(tmp_path / 'none.ply', 'no such file')


@pytest.mark.parametrize(
    'which, value, match',
    [
        (0, np.nan, 'centres of Gaussian 1 is not finite'),
        (1, 0.0, 'scale of Gaussian 1'),
        (1, -1.0, 'scale of Gaussian 1'),
        (2, 0.0, 'quaternion of Gaussian 1 is zero'),
        (3, np.inf, 'density of Gaussian 1'),
    ],
)
def test_write_refuses_values(tmp_path, which, value, match):
    arrays = list(cloud())
    arrays[which][1] = value
    with pytest.raises(InputError, match=match):
        write_ply(tmp_path / 'a.ply', *arrays)
    assert not list(tmp_path.iterdir())


def test_write_refuses_shapes(tmp_path):
    centres, scales, q, density = cloud()
    path = tmp_path / 'a.ply'
    for args, match in (
        ((centres[:, :2], scales, q, density), 'centres must'),
        ((centres, scales[:3], q, density), 'scales must'),
        ((centres, scales, q[:, :3], density), 'quaternions must'),
        ((centres, scales, q, np.ones((5, 2))), 'density must'),
        ((centres[:0], scales[:0], q[:0], density[:0]), 'empty'),
    ):
        with pytest.raises(InputError, match=match):
            write_ply(path, *args)
    with pytest.raises(InputError, match='cannot be written'):
        write_ply(tmp_path / 'none' / 'a.ply', *cloud())


PLY = b'ply\nformat %s 1.0\nelement vertex 2\nproperty float x\nproperty list uchar int i\nend_header\n'


@pytest.mark.parametrize('kind, body', [(b'ascii', b'1 2\n3 4\n'), (b'binary_big_endian', bytes(10))])
def test_elements_of_any_ply(tmp_path, kind, body):
    path = tmp_path / 'a.ply'
    path.write_bytes(PLY % kind + body)
    require_elements(path)
    for old, new, match in (
        (b'element vertex 2', b'element vertex 999999999', 'more than its'),
        (b'element vertex 2', b'element vertex ' + b'9' * 30, 'no count'),
        (b'element vertex 2', b'element vertex', 'no count'),
        (b'element vertex 2\n', b'', 'to no element'),
        (b'element', b'end_header\nelement', 'no elements'),
        (b'end_header', b'', 'no end'),
        (b'ply', b'', 'does not begin'),
    ):
        path.write_bytes((PLY % kind + body).replace(old, new, 1))
        with pytest.raises(InputError, match=match):
            require_elements(path)


@pytest.mark.parametrize('missing', [1, 4])
def test_a_file_that_lacks_its_last_bytes(tmp_path, missing):
    write_ply(tmp_path / 'a.ply', *cloud())
    require_elements(tmp_path / 'a.ply')
    (tmp_path / 'a.ply').write_bytes((tmp_path / 'a.ply').read_bytes()[:-missing])
    with pytest.raises(InputError, match='announces more'):
        require_elements(tmp_path / 'a.ply')
