"""What a checkpoint holds, checked as a whole: names, types, shapes that agree with each other, ranges.

values.*, first.*, second.*   float32 [N, size], the parameters of the forward model and Adam's moments; of a neural field, for
                              which N and M are 0, float32 [parameters, 1]
gradient, seen                float32 [N]
born                          bool [N]
array.initial                 float32 [M, 3]
array.order                   whole numbers [K], views that come next
array.average.*               like values.*, where the fit averages
array.poses.*                 float64 [views, 3 or 6] and steps, whole numbers [views], where the fit corrects poses
array.response.*              float64 [rows, numbers], where the fit finds a response: air, gain
array.search.*                where the fit searches for the step to stop at: float64 errors [looks], whole numbers iterations
                              [looks], kept [1] and views [1]; start.*, like values.*, until the search has ended. Views then are
                              those that the search sees. Earlier programs also wrote rows, float64 [any]
array.share                   float32 [N], where the fit models two materials
array.scattered               float64 [2, views, rows, columns], where it models scatter
extra                         text: plain values as JSON, named in `_PLAIN`
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lingo_mi.calibration.response.part import SMOOTH
from lingo_mi.common.errors import InputError, shown
from lingo_mi.fitting.models import parameter_shapes
from lingo_mi.fitting.settings import HELD_OUT, Settings
from lingo_mi.geometry.base import Geometry
from lingo_mi.reconstruction.held_out import LEAST_VIEWS, held_out_views
from lingo_mi.scene.description import NAMES, read_scanner

VERSION = 1  # of the checkpoints written now; those of earlier programs have neither a version nor a checksum
_SEARCH = 'array.search.'
_SEEN = _SEARCH + 'views'  # of the search; checkpoints of earlier programs lack it
_ROWS = _SEARCH + 'rows'  # which only they have
_NEVER_NEGATIVE = (
    'gradient',
    'seen',
    'array.poses.steps',
    *(_SEARCH + name for name in ('errors', 'iterations', 'kept', 'views')),
)
_OF_EFFECTS = 'array.share', 'array.scattered'  # not every effect has both


def settings_of(extra: dict) -> Settings:
    """The settings of a checkpoint, from its plain values. Raises InputError if this program does not know them."""
    return Settings().changed(**{k: tuple(v) if isinstance(v, list) else v for k, v in extra['settings'].items()})


def geometry_of(extra: dict) -> Geometry:
    """The geometry of the scan that was fitted, as given. Raises InputError if it is none."""
    return read_scanner(extra['scanner'])[0]


def require_sound(arrays: dict[str, np.ndarray], extra: Any) -> None:
    """Raises InputError, which says what is wrong, unless the arrays of a checkpoint, by name, and its plain values belong to a
    fit that can go on."""
    settings = _require_plain(extra)
    searching = any(name.startswith(_SEARCH + 'start.') for name in arrays)
    views = extra['views']
    if searching and settings.stopping.stop == 'on' and views >= LEAST_VIEWS:
        views -= len(held_out_views(views, HELD_OUT))
        if (seen := arrays.get(_SEEN)) is not None:  # fewer than these, where views are without a valid pixel
            _require_array(_SEEN, seen, 'int', (1,))
            _require(0 < seen[0] <= views, f'{_SEEN} must be from 1 to {views}')
            views = int(seen[0])
    expected = _expected(settings, views, arrays['born'].size if 'born' in arrays else 0, searching)
    allowed = dict(expected)
    if not extra.get('effects', True):
        allowed = {name: v for name, v in expected.items() if name not in _OF_EFFECTS}
    for name in expected.keys() - {*_OF_EFFECTS, _SEEN, _ROWS} - arrays.keys():
        raise InputError(f'{name} is missing')
    for name in arrays.keys() - allowed.keys():
        raise InputError(f'{shown(name)} does not belong there')
    for name, array in arrays.items():
        _require_array(name, array, *allowed[name])
    if settings.stopping.stop == 'on':
        _require_search(arrays, settings, extra['iteration'], searching)
    held = len(arrays['born']), len(arrays['array.initial'])
    if settings.cloud:
        _require(min(held) > 0, 'it holds no Gaussian')
    else:
        _require(held == (0, 0), 'it holds Gaussians, but it is of a neural field')
    order, steps = arrays['array.order'], arrays.get('array.poses.steps')
    _require(
        not len(order) or order.min() >= 0 and order.max() < views and len(np.unique(order)) == len(order),
        'array.order holds views twice, or some that the scan has not',
    )
    made = extra['iteration'] * min(settings.batch, views)
    _require(
        steps is None or steps.max() <= made == steps.sum(),
        f'array.poses.steps does not add up to the {made} that were made',
    )


def _expected(settings: Settings, views: int, count: int, searching: bool) -> dict[str, tuple[str, tuple]]:
    """Type, as NumPy spells it, and shape of every array by name; None is any length."""
    shapes = parameter_shapes(settings, count)
    found: dict[str, tuple[str, tuple]] = {'born': ('bool', (count,)), 'array.order': ('int', (None,))}
    found |= {f'{g}.{k}': ('float32', shape) for g in ('values', 'first', 'second') for k, shape in shapes.items()}
    found |= dict.fromkeys(('gradient', 'seen', 'array.share'), ('float32', (count,)))
    found |= {'array.initial': ('float32', (None, 3)), 'array.scattered': ('float64', (2, views, None, None))}
    if settings.adam.average > 0:
        found |= {f'array.average.{k}': ('float32', shape) for k, shape in shapes.items()}
    if max(settings.adam.rate_pose) > 0:
        found |= {f'array.poses.{k}': ('float64', (views, 3)) for k in ('turn', 'shift')}
        found |= {f'array.poses.{k}': ('float64', (views, 6)) for k in ('first', 'second')}
        found |= {'array.poses.steps': ('int', (views,))}
    varies = dict(air=settings.calibration.fit_air, gain=settings.calibration.fit_gain)
    rows = dict(view=views, smooth=min(SMOOTH, views - 1) + 1)
    found |= {f'array.response.{k}': ('float64', (rows[x], 1)) for k, x in varies.items() if x != 'off'}
    if settings.stopping.stop == 'on':
        found |= dict.fromkeys((_SEARCH + 'errors', _ROWS), ('float64', (None,)))
        found |= {f'{_SEARCH}iterations': ('int', (None,)), f'{_SEARCH}kept': ('int', (1,)), _SEEN: ('int', (1,))}
        if searching:
            found |= {f'{_SEARCH}start.{k}': ('float32', (None, *shape[1:])) for k, shape in shapes.items()}
    return found


def _require_search(arrays: dict[str, np.ndarray], settings: Settings, iteration: int, searching: bool):
    """Raises InputError unless what the search has seen belongs together."""
    looks, kept = arrays[f'{_SEARCH}iterations'].tolist(), int(arrays[f'{_SEARCH}kept'][0])
    seen = looks == sorted(set(looks)) and len(arrays[f'{_SEARCH}errors']) == len(looks)
    seen = seen and (kept in looks and 0 < looks[0] if looks else searching and kept == 0)
    if searching:
        start = {k: arrays[f'{_SEARCH}start.{k}'] for k in parameter_shapes(settings, 0)}
        shapes = parameter_shapes(settings, len(start['centre']) if settings.cloud else 0)
        seen = seen and all(start[k].shape == shape for k, shape in shapes.items())
        seen = seen and (not looks or looks[-1] <= iteration)
    _require(seen, 'the arrays array.search do not belong together')
    _require(searching or iteration <= kept, "iteration is beyond the search's")
    _require(not looks or looks[-1] <= settings.iterations, "the search is beyond the settings' iterations")


def _require_array(name: str, array: np.ndarray, kind: str, shape: tuple):
    of_kind = array.dtype.kind == 'i' if kind == 'int' else array.dtype == kind
    if not of_kind or array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape)):
        wanted = ', '.join('n' if n is None else str(n) for n in shape)
        raise InputError(f'{name} must be {kind} [{wanted}], not {shown(array.dtype)} {list(array.shape)}')
    _require(array.dtype.kind != 'f' or np.isfinite(array).all(), f'{name} holds NaN or infinity')
    never_negative = name in _NEVER_NEGATIVE or '.second' in f'.{name}'
    _require(not never_negative or not array.size or array.min() >= 0, f'{name} holds negative numbers')


def _require_plain(extra: Any) -> Settings:
    """The settings, once all plain values are in their ranges."""
    _require(isinstance(extra, dict), 'extra must be a dictionary')
    version = extra.get('version', VERSION)
    if version != VERSION or isinstance(version, bool):
        raise InputError(f'its version is {shown(version)}, but this program reads {VERSION}')
    for name, (wanted, good) in _PLAIN.items():
        if name not in extra:
            if name in ('moments', 'traits') or 'version' not in extra and name in ('unit', 'effects'):
                continue
            raise InputError(f'{name} is missing')
        if not good(extra[name]):
            raise InputError(f'{name} must be {wanted}, not {shown(extra[name])}')
    if strange := extra.keys() - _PLAIN.keys() - {'version'}:
        raise InputError(f'{shown(min(strange))} does not belong there')
    try:
        settings = settings_of(extra)
        seen = len(geometry_of(extra))
    except InputError as error:
        raise InputError(f'in its settings or its scanner, {error}') from None
    _require(seen == extra['views'], f'views is {shown(extra["views"])}, but the scanner has {seen}')
    steps = [entry['iteration'] for entry in extra['history']]
    _require(extra['iteration'] <= settings.iterations, "iteration is beyond the settings' iterations")
    least = 1 if settings.cloud else 0
    _require(all(entry['gaussians'] >= least for entry in extra['history']), 'history has no Gaussians')
    _require(steps == sorted(set(steps)) and max(steps, default=0) <= extra['iteration'], 'history is out of order')
    return settings


def _count(value: Any, least: int = 0, most: float = math.inf) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _number(value: Any, least: float = -math.inf) -> bool:
    """Whether a value is a finite number from `least` on. Those that float64 cannot hold are not."""
    if not isinstance(value, int | float) or isinstance(value, bool) or abs(value) > 1e300:
        return False
    return math.isfinite(value) and value >= least


def _is_rng(value: Any) -> bool:
    """Whether this is the state of NumPy's PCG64."""
    if not isinstance(value, dict) or value.keys() != {'bit_generator', 'state', 'has_uint32', 'uinteger'}:
        return False
    state = value['state']
    return (
        value['bit_generator'] == 'PCG64'
        and isinstance(state, dict)
        and state.keys() == {'state', 'inc'}
        and all(_count(x, 0, 2**128 - 1) for x in state.values())
        and _count(value['has_uint32'], 0, 1)
        and _count(value['uinteger'], 0, 2**32 - 1)
    )


def _is_moments(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_number, value))


def _is_traits(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and value.keys() == {'valid', 'effects'}
        and all(x is None or isinstance(x, str) and len(x) == 64 for x in value.values())
    )


def _is_history(value: Any) -> bool:
    """Whether these are measurements over time. Those of quality may be missing (None), NaN or infinite."""
    return isinstance(value, list) and all(
        isinstance(entry, dict)
        and _count(entry.get('iteration'), 1)
        and _number(entry.get('seconds'), 0)
        and _number(entry.get('loss'))
        and _count(entry.get('gaussians'))
        and all(x is None or isinstance(x, float) or _number(x) for x in entry.values())
        for entry in value
    )


def _is_scanner(value: Any) -> bool:
    """Whether this may be what `scene.description.describe` gives: no file is named."""
    return (
        isinstance(value, dict)
        and value.get('type') == 'ct_scanner'
        and value.keys() <= {*NAMES, 'type', 'view'}
        and all(isinstance(x, str) or _number(x) for x in value.values())
        and _are_numbers(str(value.get('poses', '')))
    )


def _are_numbers(text: str) -> bool:
    try:
        return all(math.isfinite(float(x)) for x in text.replace(',', ' ').split())
    except ValueError:
        return False


_PLAIN = {
    'seed': ('a whole number from 0 to 2^64 - 1', lambda value: _count(value, 0, 2**64 - 1)),
    'rng': ('the state of a PCG64', _is_rng),
    'iteration': ('a whole number from 0 on', _count),
    'seconds': ('a number from 0 on', lambda value: _number(value, 0)),
    'history': ('a list of measurements', _is_history),
    'info': (
        'a dictionary with its seconds',
        lambda value: isinstance(value, dict) and _number(value.get('seconds', 0), 0),
    ),
    'settings': ('a dictionary', lambda value: isinstance(value, dict)),
    'unit': ('a positive number', lambda value: _number(value, 0) and value > 0),
    'effects': ('true or false', lambda value: isinstance(value, bool)),
    'views': ('a whole number from 1 on', lambda value: _count(value, 1)),
    'scanner': ('the numbers of a ct_scanner', _is_scanner),
    'signal': ('a number', _number),
    'moments': ('three numbers', _is_moments),
    'traits': ('digests of the valid pixels and of the effects', _is_traits),
}


def _require(good: Any, message: str):
    if not good:
        raise InputError(message)
