"""The rules from the values of a file to densities, and how much of a file is read."""

import io

import numpy as np
import pytest

from helpers.volume_files import COUNTS, HU, SHAPE, read_array, refused
from lingo_mi.common.errors import InputError
from lingo_mi.files import voxels
from lingo_mi.files.volumes import read_volume


def test_counts_are_divided_by_their_maximum(tmp_path):
    v = read_array(tmp_path, COUNTS)
    assert v.data.dtype == np.float32 and v.unit == 'normalised'
    np.testing.assert_allclose(v.data, COUNTS / 119, rtol=1e-6)


def test_hounsfield_units_by_the_clip_rule(tmp_path):
    hu = HU.copy()
    hu[0, 0, :4] = -3000, 0, 500, 3071
    v = read_array(tmp_path, hu)
    np.testing.assert_allclose(v.data[0, 0, :4], [0, 1 / 3, 0.5, 1], rtol=1e-6)
    assert v.unit == 'normalised' and v.data.min() == 0 and v.data.max() == 1


def test_hounsfield_units_with_mu_water(tmp_path):
    hu = HU.copy()
    hu[0, 0, :4] = -3000, -1000, 0, 1000
    v = read_array(tmp_path, hu, mu_water=0.02)
    np.testing.assert_allclose(v.data[0, 0, :4], [0, 0, 0.02, 0.04], rtol=1e-6)
    assert v.unit == '1/mm'


def test_density_within_0_and_1_is_kept(tmp_path):
    density = (COUNTS / 300).astype(np.float64)
    np.testing.assert_array_equal(read_array(tmp_path, density).data, density.astype(np.float32))


def test_noise_below_zero_becomes_zero_and_large_floats_are_scaled(tmp_path):
    density = COUNTS / 60 - 0.05
    v = read_array(tmp_path, density)
    assert v.data.min() == 0 and v.data.max() == 1
    assert v.data[2, 3, 4] == pytest.approx(density[2, 3, 4] / density.max())


def test_ambiguous_negative_values_ask_for_hu(tmp_path):
    for crop in (COUNTS.astype(int) - 20, COUNTS - 20.0, COUNTS / 60 - 0.5):
        np.save(tmp_path / 'v.npy', crop)
        refused(tmp_path / 'v.npy', 'give mu_water=MU.*hu=True.*hu=False')
    np.save(tmp_path / 'v.npy', COUNTS.astype(int) - 20)
    np.testing.assert_allclose(read_volume(tmp_path / 'v.npy', hu=True).data, (COUNTS - 20.0 + 1000) / 3000, rtol=1e-6)
    assert read_volume(tmp_path / 'v.npy', hu=False).data.min() == 0
    # As --mu-water says.
    np.testing.assert_allclose(
        read_volume(tmp_path / 'v.npy', mu_water=0.02).data, 0.02 * (COUNTS - 20.0 + 1000) / 1000, rtol=1e-6
    )
    np.save(tmp_path / 'v.npy', HU)
    np.testing.assert_allclose(read_volume(tmp_path / 'v.npy', hu=False).data, np.maximum(HU, 0) / HU.max(), rtol=1e-6)


def test_bad_values(tmp_path):
    for array, match, options in (
        (COUNTS * 0, 'empty', {}),
        (COUNTS[0], '3 dimensions', {}),
        (COUNTS[:0], 'non-empty', {}),
        (np.full(SHAPE, np.nan), 'NaN', {}),
        (np.full(SHAPE, 1j), 'real numbers', {}),
        (COUNTS, 'do not look like Hounsfield', {'mu_water': 0.02}),
        (HU, 'mu_water must be', {'mu_water': -1}),
        (HU, 'mu_water must be', {'mu_water': 0}),
        (COUNTS, 'spacing must be', {'spacing': (1, 2)}),
        (COUNTS, 'spacing must be', {'spacing': 0}),
        (COUNTS, 'spacing must be', {'spacing': 'a'}),
    ):
        np.save(tmp_path / 'v.npy', array)
        refused(tmp_path / 'v.npy', match, **options)


def test_values_beyond_float32(tmp_path):
    np.save(tmp_path / 'v.npy', COUNTS * 1e300)
    refused(tmp_path / 'v.npy', 'range of float32')


def test_a_little_below_zero_is_noise(tmp_path):
    """Values down to minus a tenth of the highest value are noise, also if that value is not 1."""
    values = np.where(COUNTS == 3, -0.15, COUNTS * (2.0 / 119) + 1e-3)
    assert read_array(tmp_path, values).data.min() <= 0
    np.save(tmp_path / 'v.npy', np.where(COUNTS == 3, -0.25, values))
    refused(tmp_path / 'v.npy', 'Hounsfield')


@pytest.mark.parametrize('ratio, bytes_a_voxel', [(1, 8), (1000, 12)])
def test_memory_that_an_array_of_a_file_needs(tmp_path, monkeypatch, ratio, bytes_a_voxel):
    """It needs float32 twice, and its own bytes if they are unpacked first."""
    asked = []
    monkeypatch.setattr(voxels, 'require_room', lambda size, *_: asked.append(size))
    (tmp_path / 'v').write_bytes(bytes(480))
    assert voxels.require_claim(tmp_path / 'v', SHAPE, np.dtype('f4'), ratio) == 480
    assert asked == [120 * bytes_a_voxel]


def test_what_follows_an_array_is_read_only_where_asked():
    content = bytes(120 + voxels._CHUNK + 1)
    assert len(voxels.read_exactly(io.BytesIO(content), 'v', 120)) == 120
    voxels.require_end(io.BytesIO(content[121:]), 'v')
    with pytest.raises(InputError, match='more data follow'):
        voxels.require_end(io.BytesIO(content[120:]), 'v')
