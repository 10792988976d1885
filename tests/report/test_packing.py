"""Arrays as a page holds them: right to half a step, 0 kept as it is, within the budget."""

import base64
import gzip
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lingo_mi.report.packing import Arrays, bits_within, preview, quantised
from lingo_mi.report.payload import error_maps, slice_payload


def unpacked(packed):
    """Unpack like `decode.js`, step by step."""
    low, high = np.frombuffer(gzip.decompress(base64.b64decode(packed.text)), np.uint8).reshape(2, -1).astype(int)
    folded = low | high << 8
    changes = (folded >> 1) ^ -(folded & 1)
    return packed.low + packed.step * (np.cumsum(changes) & 0xFFFF).reshape(packed.shape, order='F')


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([8, 10, 12, 14, 16]), st.floats(-50, 50), st.floats(1e-6, 1e4))
def test_values_are_right_to_half_a_step(seed, bits, low, size):
    array = low + size * np.random.default_rng(seed).random((5, 4, 3))
    packed = quantised(array, low, low + size, bits)
    assert packed.step <= size / (2**bits - 2) * 1.0001
    assert np.abs(unpacked(packed) - array).max() <= packed.step * 0.501


def test_nothing_stays_nothing():
    array = np.array([-0.3, 0.0, 0.7])[:, None, None]
    for bits in (8, 16):
        assert abs(unpacked(quantised(array, -0.3, 0.7, bits))[1, 0, 0]) < 1e-12


def test_one_value():
    assert (unpacked(quantised(np.full((2, 2, 2), 3.0), 3.0, 3.0)) == 3).all()


def test_bits_are_as_many_as_the_budget_allows():
    rng = np.random.default_rng(0)
    noise = rng.random((48, 48, 48)).astype(np.float32)
    sizes = {bits: len(quantised(noise, 0, 1, bits).text) for bits in (16, 12, 8)}
    assert bits_within([noise], 0, 1, 1.05 * sizes[16]) == 16
    assert bits_within([noise], 0, 1, 1.05 * sizes[12]) == 12
    assert bits_within([noise], 0, 1, 0.5 * sizes[8]) is None


def test_a_map_of_errors_is_on_the_grid_of_its_volumes():
    noise, arrays = np.random.default_rng(0).random((51, 51, 51)).astype(np.float32), Arrays()
    payload = slice_payload({'a': noise, 'b': 1 - noise}, (1, 1, 1), (0, 0, 0), arrays, budget=3e4)
    assert payload['preview'] > 1
    error_maps({'map': noise}, payload, arrays)
    assert list(arrays['map0'].shape) == payload['shape']


def test_places_of_a_volume_that_is_a_preview_already():
    shape, spacing, centre = (10, 10, 7), (2.0, 2.0, 3.0), (1.0, 0.0, -1.0)
    volume = np.random.default_rng(0).random(shape).astype(np.float32)
    full = slice_payload({'a': volume}, spacing, centre, Arrays())
    small, by = preview(volume, 100)
    payload = slice_payload({'a': small}, spacing, centre, Arrays(), of=(shape, by))
    assert payload['preview'] == by and payload['spacing'] == [by * s for s in spacing]
    first = [c - (n - 1) / 2 * s for c, n, s in zip(full['centre'], full['shape'], full['spacing'])]  # a voxel's centre
    block = [c - (n - 1) / 2 * s for c, n, s in zip(payload['centre'], payload['shape'], payload['spacing'])]
    np.testing.assert_allclose(block, [f + (by - 1) / 2 * s for f, s in zip(first, spacing)])


def test_preview_is_the_mean_of_blocks():
    volume = np.random.default_rng(0).random((9, 8, 4))
    small, by = preview(volume, 9 * 8 * 4 // 8 + 1)
    assert by == 2 and small.shape == (4, 4, 2)
    np.testing.assert_allclose(small[1, 2, 0], volume[2:4, 4:6, :2].mean())
    assert preview(volume)[1] == 1


@pytest.mark.parametrize('size', [64, pytest.param(256, marks=pytest.mark.slow)])
def test_the_worst_volume_stays_within_the_budget(size):
    """Reconstruction and truth are noise, and the budget is in proportion to 20 MB for 256^3."""
    rng = np.random.default_rng(0)
    budget, arrays = 20e6 * (size / 256) ** 3, Arrays()
    volumes = {name: rng.random((size, size, size), dtype=np.float32) for name in ('Reconstruction', 'Truth')}
    payload = slice_payload(volumes, (1, 1, 1), (0, 0, 0), arrays, 'Truth', budget)
    assert sum(len(a.text) for a in arrays.values()) <= 1.02 * budget and payload['preview'] == 2
    half = size // 2
    assert payload['shape'] == [half] * 3 and payload['spacing'] == [2, 2, 2] and payload['centre'] == [0, 0, 0]


def test_budgets_leave_room():
    """They share 30 MB: volumes, views, libraries, cloud and surfaces."""
    from lingo_mi.report import payload, template

    libraries = len(template._script())
    cloud = 11 * payload.MOST_POINTS * 2 * 4 / 3
    surfaces = 2 * (3 + 6) * payload.MOST_VERTICES * 2 * 4 / 3
    assert payload.VOLUME_BYTES + payload.VIEW_BYTES + libraries + cloud + surfaces < 30e6
    assert not re.search('</script', template._script())
