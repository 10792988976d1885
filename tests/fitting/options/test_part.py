"""Options of a method: by flat names, as parts, and from the text of a command line."""

from dataclasses import fields

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.methods.by_name import CLOUDS, METHODS, method_of
from lingo_mi.fitting.options.part import Part, kinds_of

EVERY = [(method, name) for method in METHODS for name in METHODS[method].flat()]


def parts_of(method):
    return [part for part in vars(method).values() if isinstance(part, Part)]


def having(name):
    """The methods with an option, or all if none has it."""
    return [method for method in METHODS.values() if name in method.flat()] or list(METHODS.values())


@pytest.mark.parametrize(
    'name, text, value',
    [
        ('iterations', '1e2', 100),
        ('lambda_tv', '0', 0.0),
        ('normalise', 'True', True),
        ('rate_centre', '1e-3', (1e-3, 1e-3)),
        ('rate_centre', '1e-3,1e-4', (1e-3, 1e-4)),
        ('start', 'edges', 'edges'),
        ('densify', 'halve', 'halve'),
    ],
)
def test_values(name, text, value):
    value_read = lm.R2().changed(**{name: text}).flat()[name]
    assert value_read == value and type(value_read) is type(value)


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
        ('density', 'xyz', "density is 'paper', 'r2', 'lsq' or 'fdk', not 'xyz'"),
        ('start', 'lingo', "'masks'"),
        ('densify', 'double', "'clone', 'opacities' or 'halve', not 'double'"),
        ('coarse_share', '0.5', 'unknown'),
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
def test_bad_texts(name, text, message):
    require_refusal(name, text, message)


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
        ('start', 3, "'edges'"),
        ('outside', 3, 'text'),
        ('rate_density', 0.01, 'rate_density takes two numbers, first and last, such as (0.01, 0.001), not 0.01'),
        ('rate_density', (1, 2, 3), 'two numbers'),
        ('rate_density', ('1', '2'), 'two numbers'),
        ('rate_density', (True, 2), 'two numbers'),
    ],
)
def test_bad_values_of_python(name, value, message):
    require_refusal(name, value, message)


def require_refusal(name, value, message):
    """Every method that has the option refuses the value, in one line."""
    for method in having(name):
        with pytest.raises(InputError) as caught:
            method.changed(**{name: value})
        assert message in str(caught.value) and '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'method, name, message',
    [
        ('r2', 'rate_densty', "unknown setting 'rate_densty', did you mean rate_density?"),
        ('r2', 'wavelet', "unknown setting 'wavelet': see the documentation of R2"),
        ('r2', 'V_S', "unknown setting 'V_S'"),
        ('fast', 'split_size', "unknown setting 'split_size'"),
        ('fast', 'fdk_threshold', "unknown setting 'fdk_threshold'"),
        ('3dgs', 'fit_air', "unknown setting 'fit_air'"),
        ('naf', 'n_points', "unknown setting 'n_points'"),
        ('naf', 'start', "unknown setting 'start'"),
    ],
)
def test_names_that_a_method_does_not_have(method, name, message):
    with pytest.raises(InputError) as caught:
        METHODS[method].changed(**{name: 1})
    assert message in str(caught.value) and '\n' not in str(caught.value)


EXTREME = -1, float('nan'), float('inf'), 1e300, 1e308, 10**400, 10**5000, 'x', None, [], (1e300, 1e300), (10**400, 1)
TEXTS = '', '-1', 'nan', 'inf', '1e300', '1e400', '1' * 400, '1' * 5000, ','


@pytest.mark.parametrize('method, name', EVERY)
def test_extreme_values(method, name):
    """Every option refuses them in one line, in whichever way it is given."""
    for value in (*EXTREME, *TEXTS, True):
        if value is True and name in ('normalise', 'nesterov') or name == 'fdk_threshold' and value in (-1, '-1'):
            continue
        with pytest.raises(InputError) as caught:
            METHODS[method].changed(**{name: value})
        message = str(caught.value)
        assert name in message and '\n' not in message and len(message) < 300


KINDS = {type(x) for method in METHODS.values() for x in (method, *parts_of(method))}


@pytest.mark.parametrize('part', sorted(KINDS, key=lambda kind: kind.__name__))
def test_extreme_values_of_the_parts(part):
    for f in fields(part):
        for value in EXTREME:
            if (f.name, value) != ('fdk_threshold', -1):
                with pytest.raises(InputError, match=f.name) as caught:
                    part(**{f.name: value})
                assert '\n' not in str(caught.value)


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
def test_values_of_python(name, value, expected):
    for method in having(name):
        actual = method.changed(**{name: value}).flat()[name]
        assert actual == expected and type(actual) is type(expected)


def test_method_of():
    actual = method_of('lingo:V_S=1,n_points=70', n_points=90, iterations=5)
    assert (actual.start.V_S, actual.start.n_points, actual.iterations) == (1.0, 70, 5)
    for method in ('LINGO', 'lingo:V=1', 'lingo:V_S', ':V_S=1', ''):
        with pytest.raises(InputError):
            method_of(method)


@pytest.mark.parametrize('method', METHODS)
def test_flat_names(method):
    """Every value has one, no two share one, and together they are the whole method."""
    method_class = METHODS[method]
    flat, parts = method_class.flat(), parts_of(method_class)
    named = [part for part in parts if part.name]
    assert len(flat) == len(vars(method_class)) - len(parts) + len(named) + sum(len(vars(part)) for part in parts)
    assert type(method_class)().changed(**flat) == method_class
    if method in CLOUDS:
        assert lm.R2().changed(**flat).flat() == flat and lm.LINGO().changed(**flat).flat() == flat
        assert flat['lambda_tv'] == method_class.loss.lambda_tv and flat['scale_min'] == method_class.bounds.scale_min
        assert flat['start'] == method_class.start.name and flat['densify'] == method_class.densify.name


def test_changed_keeps_the_rest():
    before = METHODS['fast']
    after = before.changed(lambda_tv=0.1, iterations=900)
    assert after.flat() == before.flat() | dict(lambda_tv=0.1, iterations=900)
    assert after.rates is before.rates and before.loss.lambda_tv == 0.4


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
    for method in having(name):
        assert method.changed(**{name: within}).flat()[name] == within
        with pytest.raises(InputError, match=name):
            method.changed(**{name: beyond})


# ---- parts in several kinds --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'before, changes, after',
    [
        (lm.R2(), dict(start='edges'), lm.EdgeStart()),
        (lm.R2(), dict(start='edges', n_points=70), lm.EdgeStart(n_points=70)),
        (lm.R2().changed(n_points=70, fdk_rescale=0.2), dict(start='edges'), lm.EdgeStart(n_points=70)),
        (lm.R2().changed(n_points=70, fdk_rescale=0.2), dict(start='fdk'), lm.FDKStart(70, fdk_rescale=0.2)),
        (lm.R2(), dict(start='masks', V_S='3'), lm.MaskStart(V_S=3.0)),
        (lm.GaussianSplatting(), dict(start='edges'), lm.EdgeStart()),
        (lm.GaussianSplatting().changed(n_points=70), dict(start='edges'), lm.EdgeStart(70)),
        (lm.GaussianSplatting().changed(n_points=70), dict(start='cuboid', cuboid_step=4), lm.CuboidStart(4)),
    ],
)
def test_another_start_keeps_what_both_share(before, changes, after):
    """Shared options that were changed stay; the others take the other start's defaults."""
    changed = before.changed(**changes)
    assert changed.start == after and type(changed.start) is type(after)
    assert {k: v for k, v in vars(changed).items() if k != 'start'} == {
        k: v for k, v in vars(before).items() if k != 'start'
    }


def test_other_densification_keeps_what_both_share():
    fast = lm.Fast().changed(densify='clone', split_size=0.3)
    assert fast.densify == lm.Clone(**vars(lm.Fast().densify), split_size=0.3)
    assert fast.changed(densify='halve') == lm.Fast()


def test_options_of_another_kind_are_unknown():
    with pytest.raises(InputError, match="unknown setting 'fdk_threshold'"):
        lm.R2().changed(start='edges', fdk_threshold=0.1)
    with pytest.raises(InputError, match="unknown setting 'split_size'"):
        lm.R2().changed(split_size=0.1, densify='halve')


@pytest.mark.parametrize(
    'make, message',
    [
        (lambda: lm.R2(start='edges'), 'start must be of class Start, such as FDKStart(n_points=50000'),
        (lambda: lm.R2(start=lm.Halve()), 'start must be of class Start'),
        (lambda: lm.R2(start=lm.EdgeStart), 'start must be of class Start'),
        (lambda: lm.R2(densify=lm.EdgeStart()), 'densify must be of class Densify'),
        (lambda: lm.R2(loss=3), 'loss must be of class Loss'),
        (lambda: lm.R2(loss=None), 'loss must be of class Loss'),
        (lambda: lm.R2(loss=lm.ImageLoss()), 'loss must be of class Loss'),
        (lambda: lm.R2(rates=lm.OpacityRates()), 'rates must be of class DensityRates'),
        (lambda: lm.NAF(rates=lm.DensityRates()), 'rates must be of class FieldRates'),
        (lambda: lm.NAF(field=lm.Loss()), 'field must be of class Field'),
        (lambda: lm.GaussianSplatting(rates=lm.DensityRates()), 'rates must be of class OpacityRates'),
        (lambda: lm.GaussianSplatting(loss=lm.Loss()), 'loss has a total variation'),
        (lambda: lm.GaussianSplatting(densify=lm.Halve()), 'densify=halve is for Gaussians with densities'),
        (lambda: lm.GaussianSplatting().changed(densify='clone'), 'densify=clone is for Gaussians with densities'),
        (lambda: lm.R2(densify=lm.CloneOpacities()), 'densify=opacities is for Gaussians with opacities'),
        (lambda: lm.Fast().changed(densify='opacities'), 'densify=opacities is for Gaussians with opacities'),
        (lambda: lm.R2(start=lm.RandomStart()), 'start=random makes no densities'),
    ],
)
def test_parts_of_the_wrong_type(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value) and '\n' not in str(caught.value) and len(str(caught.value)) < 300


def test_kinds_are_those_with_a_name():
    """Abstract classes, and those that only share what others have, are not among them."""

    def shipped(kind):  # tests and studies have kinds of their own
        return {name: k for name, k in kinds_of(kind).items() if k.__module__.startswith('lingo_mi.fitting')}

    assert shipped(lm.FDKStart).keys() == {'fdk', 'masks', 'edges', 'random', 'cuboid'}
    assert shipped(lm.Clone).keys() == {'clone', 'halve', 'opacities'}
    assert {*shipped(lm.Method).values()} == {type(method) for method in METHODS.values()}
