"""Settings of a fit, from the text of a command line too."""

from dataclasses import MISSING, fields, is_dataclass

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.recipes import METHODS, settings_of
from lingo_mi.fitting.settings import Settings


@pytest.mark.parametrize(
    'name, text, value',
    [
        ('iterations', '1e2', 100),
        ('lambda_tv', '0', 0.0),
        ('normalise', 'True', True),
        ('rate_centre', '1e-3', (1e-3, 1e-3)),
        ('rate_centre', '1e-3,1e-4', (1e-3, 1e-4)),
        ('init', 'lingo', 'lingo'),
    ],
)
def test_values(name, text, value):
    found = Settings().changed(**{name: text}).flat()[name]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    'name, text, message',
    [
        ('iterations', 'inf', 'a whole number'),
        ('iterations', 'nan', 'a whole number'),
        ('iterations', '2.5', 'a whole number'),
        ('iterations', '', 'a whole number'),
        ('iterations', '0', 'in [1, 1e+09], not 0'),
        ('lambda_tv', 'inf', 'in [0, 1e+06], not inf'),
        ('lambda_tv', 'much', 'a number'),
        ('normalise', '1', 'true or false'),
        ('rate_centre', '1,2,3', 'two numbers'),
        ('rate_centre', '0', 'in [1e-12, 1000]'),
        ('occupancy_voxels', '0', 'in [1, 1e+06]'),
        ('high_fraction', '2', 'in [0, 1]'),
        ('init_density', 'xyz', "'xyz' is unknown"),
        ('outside', 'left', "'invalid', 'ignore' or 'auto'"),
        ('lambda', '1', 'unknown'),
        ('epsilon', '0', 'in [1e-30, 1]'),
        *(
            (name, '-1', f'{name} must lie in [0, ')
            for name in (
                'lambda_l1',
                'lambda_ssim',
                'lambda_gradient',
                'lambda_tv',
                'decay_steps',
                'densify_from',
                'densify_threshold',
                'split_size',
                'prune_density',
                'misses',
                'V_S',
                'low_factor',
            )
        ),
    ],
)
@pytest.mark.parametrize('method', ['r2', 'fast'])
def test_bad_texts(method, name, text, message):
    with pytest.raises(InputError) as caught:
        METHODS[method].changed(**{name: text})
    assert message in str(caught.value) and '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'name, value, message',
    [
        ('iterations', 2.5, 'a whole number'),
        ('iterations', True, 'a whole number'),
        ('iterations', None, 'a whole number'),
        ('iterations', float('nan'), 'a whole number'),
        ('lambda_tv', (1, 2), 'a number'),
        ('lambda_tv', False, 'a number'),
        ('lambda_tv', 1j, 'a number'),
        ('values_per_gaussian', None, 'a number'),
        ('normalise', 1, 'True or False'),
        ('init', 3, 'text'),
        ('rate_density', 0.01, 'rate_density takes two numbers, first and last, such as (0.01, 0.001), not 0.01'),
        ('rate_density', (1, 2, 3), 'two numbers'),
        ('rate_density', ('1', '2'), 'two numbers'),
        ('rate_density', (True, 2), 'two numbers'),
        ('rate_densty', (1, 2), "unknown setting 'rate_densty', did you mean rate_density?"),
        ('wavelet', 1, "unknown setting 'wavelet': see the documentation of Settings"),
    ],
)
@pytest.mark.parametrize('method', ['r2', 'fast'])
def test_bad_values_of_python(method, name, value, message):
    with pytest.raises(InputError) as caught:
        METHODS[method].changed(**{name: value})
    assert message in str(caught.value) and '\n' not in str(caught.value)


EXTREME = -1, float('nan'), float('inf'), 1e300, 1e308, 10**400, 10**5000, 'x', None, [], (1e300, 1e300), (10**400, 1)
TEXTS = '', '-1', 'nan', 'inf', '1e300', '1e400', '1' * 400, '1' * 5000, ','


@pytest.mark.parametrize('name', Settings().flat())
def test_extreme_values(name):
    """Every setting refuses them in one line, in whichever way it is given."""
    for value in (*EXTREME, *TEXTS, True):
        if value is True and name in ('normalise', 'nesterov') or name == 'fdk_threshold' and value in (-1, '-1'):
            continue
        with pytest.raises(InputError) as caught:
            Settings().changed(**{name: value})
        message = str(caught.value)
        assert name in message and '\n' not in message and len(message) < 300


@pytest.mark.parametrize('part', [Settings, *(type(part) for part in vars(Settings()).values() if is_dataclass(part))])
def test_extreme_values_of_the_parts(part):
    for f in fields(part):
        for value in EXTREME if f.default is not MISSING else ():
            if (f.name, value) != ('fdk_threshold', -1):
                with pytest.raises(InputError, match=f.name):
                    part(**{f.name: value})


@pytest.mark.parametrize(
    'name, value, expected',
    [
        ('iterations', np.int64(7), 7),
        ('iterations', 2e3, 2000),
        ('lambda_tv', np.float64(0.5), 0.5),
        ('lambda_tv', 1, 1),
        ('values_per_gaussian', 3.5, 3.5),
        ('values_per_gaussian', '3.5', 3.5),
        ('normalise', np.bool_(True), True),
        ('rate_density', np.array([0.2, 0.1]), (0.2, 0.1)),
        ('rate_density', [1, 0.1], (1, 0.1)),
    ],
)
@pytest.mark.parametrize('method', ['r2', 'fast'])
def test_values_of_python(method, name, value, expected):
    found = METHODS[method].changed(**{name: value}).flat()[name]
    assert found == expected and type(found) is type(expected)


def test_settings_of():
    found = settings_of('r2:V_S=1,n_points=70', n_points=90, iterations=5)
    assert (found.start.V_S, found.start.n_points, found.iterations) == (1.0, 70, 5)
    for method in ('R2', 'r2:V=1', 'r2:V_S', ':V_S=1', ''):
        with pytest.raises(InputError):
            settings_of(method)


@pytest.mark.parametrize('method', METHODS)
def test_flat_names(method):
    """Every value has one, no two share one, and they are all that a set of settings is."""
    settings = METHODS[method]
    flat = settings.flat()
    parts = [part for part in vars(settings).values() if is_dataclass(part)]
    assert len(flat) == len(vars(settings)) - len(parts) + sum(len(vars(part)) for part in parts)
    assert Settings().changed(**flat) == settings
    assert flat['lambda_tv'] == settings.loss.lambda_tv and flat['scale_min'] == settings.bounds.scale_min


def test_changed_keeps_the_rest():
    before = METHODS['fast']
    after = before.changed(lambda_tv=0.1, iterations=900)
    assert after.flat() == before.flat() | dict(lambda_tv=0.1, iterations=900)
    assert after.adam is before.adam and before.loss.lambda_tv == 0.4


@pytest.mark.parametrize(
    'name, within, beyond',
    [
        ('cuboid_step', 10**6, 10**6 + 1),
        ('fdk_threshold', 1e6, 1.5e6),
        ('fdk_threshold', -1e6, -1.5e6),
        ('fdk_rescale', 1e6, 1.5e6),
        ('scale_min', 1e-9, 0.9e-9),
        ('scale_max', 1e3, 1.1e3),
        ('rate_centre', (1e-12, 1e3), (0.9e-12, 1e3)),
        ('rate_centre', (1e3, 1e-12), (1.1e3, 1e-12)),
        ('iterations', 10**9, 10**9 + 1),
        *((name, 0, -1) for name in ('decay_steps', 'densify_from', 'densify_until', 'reset_every')),
        *((name, 1e6, 1.5e6) for name in ('low_factor', 'lambda_ssim', 'lambda_tv', 'tv_size', 'tv_stride')),
        *((name, 1, 0) for name in ('tv_size', 'tv_stride', 'cuboid_step', 'n_points', 'occupancy_voxels')),
        *((name, 10**8, 10**8 + 1) for name in ('n_points',)),
        ('high_fraction', 1.0, 1.1),
    ],
)
def test_limits(name, within, beyond):
    assert Settings().changed(**{name: within}).flat()[name] == within
    with pytest.raises(InputError, match=name):
        Settings().changed(**{name: beyond})
