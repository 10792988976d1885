"""The content of a checkpoint, checked as a whole: names, types, ranges, and shapes that agree with each other.

values.*, first.*, second.*   float32 [N, size], the parameters of the method and Adam's moments; of a neural field, for which N
                              and M are 0, float32 [parameters, 1]
gradient, visits              float32 [N]
born                          bool [N]
array.initial                 float32 [M, 3]
array.order                   whole numbers [K], views that come next
array.average.*               like values.*, if the fit averages
array.poses.*                 float64 [views, 3 or 6] and steps, whole numbers [views], if the fit corrects poses
array.response.*              float64 [rows, numbers], if the fit has a response: air, gain, pixels
array.share                   float32 [N], if the fit models two materials
array.scattered               float64 [2, views, rows, columns], if it models scatter
extra                         text: plain values as JSON, named in `_PLAIN`

Views are those that the steps see: `seen`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lingo_mi.calibration.response.part import SMOOTH
from lingo_mi.common.errors import InputError, shown
from lingo_mi.fitting.average import PREFIX as AVERAGE
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.by_name import method_of
from lingo_mi.fitting.methods.densities import DensityMethod
from lingo_mi.geometry.base import Geometry
from lingo_mi.scene.description import NAMES, read_scanner

VERSION = 2
# The plain values that are attributes of a `Checkpoint` by the same name.
PLAIN = 'unit', 'seed', 'rng', 'iteration', 'seconds', 'history', 'info', 'scan', 'effects', 'search', 'seen'
_NEVER_NEGATIVE = 'gradient', 'visits', 'array.poses.steps'
_OF_EFFECTS = 'array.share', 'array.scattered'  # not every effect has both


def require_sound(arrays: dict[str, np.ndarray], plain: Any) -> tuple[Method, Geometry]:
    """The method and the geometry of a checkpoint.

    Raises
    ------
    InputError
        Which says what is wrong, unless its arrays, by name, and its plain values belong to a fit that can go on.
    """
    method, geometry = _require_plain(plain)
    views, steps = plain['seen'], arrays.get('array.poses.steps')
    expected = _expected(method, geometry, views, arrays['born'].size if 'born' in arrays else 0)
    allowed = expected if plain['effects'] else {k: v for k, v in expected.items() if k not in _OF_EFFECTS}
    for name in expected.keys() - {*_OF_EFFECTS} - arrays.keys():
        raise InputError(f'{name} is missing')
    for name in arrays.keys() - allowed.keys():
        raise InputError(f'{shown(name)} does not belong there')
    for name, array in arrays.items():
        _require_array(name, array, *allowed[name])
    counts = len(arrays['born']), len(arrays['array.initial'])
    if method.makes_gaussians:
        _require(min(counts) > 0, 'it holds no Gaussian')
    else:
        _require(counts == (0, 0), 'it holds Gaussians, but belongs to a neural field')
    order = arrays['array.order']
    _require(
        not len(order) or order.min() >= 0 and order.max() < views and len(np.unique(order)) == len(order),
        'array.order holds views twice, or some that the scan does not have',
    )
    rendered = plain['iteration'] * min(method.batch, views)
    _require(
        steps is None or steps.max() <= rendered == steps.sum(),
        f'array.poses.steps does not add up to the {rendered} that were made',
    )
    return method, geometry


def _expected(method: Method, geometry: Geometry, views: int, count: int) -> dict[str, tuple[str, tuple]]:
    """Type, as NumPy spells it, and shape of every array by name; None is any length."""
    shapes = method.shapes(count)
    entries: dict[str, tuple[str, tuple]] = {'born': ('bool', (count,)), 'array.order': ('int', (None,))}
    entries |= {f'{g}.{k}': ('float32', shape) for g in ('values', 'first', 'second') for k, shape in shapes.items()}
    entries |= dict.fromkeys(('gradient', 'visits'), ('float32', (count,)))
    entries |= {'array.initial': ('float32', (None, 3)), 'array.losses': ('float64', (None,))}
    if method.rates.average > 0:
        entries |= {f'array.{AVERAGE}{k}': ('float32', shape) for k, shape in shapes.items()}
    if not isinstance(method, DensityMethod):
        return entries
    entries |= {'array.share': ('float32', (count,)), 'array.scattered': ('float64', (2, views, None, None))}
    corrections = method.corrections
    if corrections.moves_views:
        entries |= {f'array.poses.{k}': ('float64', (views, 3)) for k in ('turn', 'shift')}
        entries |= {f'array.poses.{k}': ('float64', (views, 6)) for k in ('first', 'second')}
        entries |= {'array.poses.steps': ('int', (views,))}
    varies = dict(air=corrections.fit_air, gain=corrections.fit_gain)
    rows = dict(view=views, smooth=min(SMOOTH, views - 1) + 1)
    if corrections.fit_pixels != 'off':
        entries |= {'array.response.pixels': ('float64', (1, math.prod(geometry.nDetector)))}
    return entries | {f'array.response.{k}': ('float64', (rows[x], 1)) for k, x in varies.items() if x != 'off'}


def _require_search(search: dict, method: Method, iteration: int, searching: bool):
    """Raises InputError unless what a search has seen belongs together."""
    steps, best = search['iterations'], search['best']
    sound = steps == sorted(set(steps)) and len(search['errors']) == len(steps)
    sound = sound and (best in steps and 0 < steps[0] if steps else searching and best == 0)
    _require(
        sound and not (searching and steps and steps[-1] > iteration), 'the parts of search do not belong together'
    )
    _require(searching or iteration <= best, "iteration is beyond the search's")
    _require(not steps or steps[-1] <= method.iterations, "the search is beyond the settings' iterations")


def _require_array(name: str, array: np.ndarray, kind: str, shape: tuple):
    of_kind = array.dtype.kind == 'i' if kind == 'int' else array.dtype == kind
    if not of_kind or array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape)):
        wanted = ', '.join('n' if n is None else str(n) for n in shape)
        raise InputError(f'{name} must be {kind} [{wanted}], not {shown(array.dtype)} {list(array.shape)}')
    _require(array.dtype.kind != 'f' or np.isfinite(array).all(), f'{name} holds NaN or infinity')
    never_negative = name in _NEVER_NEGATIVE or '.second' in f'.{name}'
    _require(not never_negative or not array.size or array.min() >= 0, f'{name} holds negative numbers')


def _require_plain(plain: Any) -> tuple[Method, Geometry]:
    """The method and the geometry, once all plain values are in their ranges."""
    _require(isinstance(plain, dict), 'extra must be a dictionary')
    version = plain.get('version')
    if version != VERSION or isinstance(version, bool):
        raise InputError(f'its version is {shown(version)}, but this program reads {VERSION}')
    for name, (wanted, good) in _PLAIN.items():
        if name not in plain:
            raise InputError(f'{name} is missing')
        if not good(plain[name]):
            raise InputError(f'{name} must be {wanted}, not {shown(plain[name])}')
    if strange := plain.keys() - _PLAIN.keys() - {'version'}:
        raise InputError(f'{shown(min(strange))} does not belong there')
    try:
        settings = {k: tuple(v) if isinstance(v, list) else v for k, v in plain['settings'].items()}
        method = method_of(plain['method']).changed(**settings)
        geometry = read_scanner(plain['scanner'])[0]
    except InputError as error:
        raise InputError(f'in its settings or its scanner, {error}') from None
    _require(method.flat().keys() == settings.keys(), f'it lacks settings of {plain["method"]}, or has others')
    views, seen, iteration = len(geometry), plain['seen'], plain['iteration']
    _require(plain['scan']['views'] == views, f'views is {shown(plain["scan"]["views"])}, but the scanner has {views}')
    _require(seen <= views, f'seen is {shown(seen)}, but the scanner has {views} views')
    stops = method.stopping.stop == 'on'
    _require((plain['search'] is not None) == stops, 'search goes with stop=on')
    _require(seen == views or stops, f'seen is {shown(seen)} of {views} views, but the fit does not search')
    if plain['search'] is not None:
        _require_search(plain['search'], method, iteration, seen < views)
    steps = [entry['iteration'] for entry in plain['history']]
    _require(iteration <= method.iterations, "iteration is beyond the settings' iterations")
    least = 1 if method.makes_gaussians else 0
    _require(all(entry['gaussians'] >= least for entry in plain['history']), 'history has no Gaussians')
    _require(steps == sorted(set(steps)) and max(steps, default=0) <= iteration, 'history is out of order')
    return method, geometry


def _count(value: Any, least: int = 0, most: float = math.inf) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _number(value: Any, least: float = -math.inf) -> bool:
    """Return whether a value is a finite number of at least `least`. A number beyond float64 is not."""
    if not isinstance(value, int | float) or isinstance(value, bool) or abs(value) > 1e300:
        return False
    return math.isfinite(value) and value >= least


def _is_rng(value: Any) -> bool:
    """Return whether this is the state of NumPy's PCG64."""
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


def _is_scan(value: Any) -> bool:
    """Return whether this is an `identity` of a scan."""
    return (
        isinstance(value, dict)
        and value.keys() == {'views', 'signal', 'moments', 'valid', 'effects'}
        and _count(value['views'], 1)
        and _number(value['signal'])
        and isinstance(value['moments'], list)
        and len(value['moments']) == 3
        and all(map(_number, value['moments']))
        and all(x is None or isinstance(x, str) and len(x) == 64 for x in (value['valid'], value['effects']))
    )


def _is_search(value: Any) -> bool:
    """Return whether this is the record of a search; see `stopping`."""
    return value is None or (
        isinstance(value, dict)
        and value.keys() == {'best', 'iterations', 'errors'}
        and _count(value['best'])
        and all(isinstance(value[name], list) for name in ('iterations', 'errors'))
        and all(map(_count, value['iterations']))
        and all(_number(error, 0) for error in value['errors'])
    )


def _is_history(value: Any) -> bool:
    """Return whether these are measurements over time. Values of quality may be missing (None), NaN or infinite."""
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
    """Return whether this may be a result of `scene.description.describe` that names no file."""
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
    'method': ('the name of a method', lambda value: isinstance(value, str) and ':' not in value),
    'settings': ('a dictionary', lambda value: isinstance(value, dict)),
    'seed': ('a whole number from 0 to 2^64 - 1', lambda value: _count(value, 0, 2**64 - 1)),
    'rng': ('the state of a PCG64', _is_rng),
    'iteration': ('a whole number from 0 on', _count),
    'seconds': ('a number from 0 on', lambda value: _number(value, 0)),
    'history': ('a list of measurements', _is_history),
    'info': (
        'a dictionary with its seconds',
        lambda value: isinstance(value, dict) and _number(value.get('seconds', 0), 0),
    ),
    'unit': ('a positive number', lambda value: _number(value, 0) and value > 0),
    'effects': ('true or false', lambda value: isinstance(value, bool)),
    'scanner': ('the numbers of a ct_scanner', _is_scanner),
    'scan': ('what tells a scan from others', _is_scan),
    'search': ('what a search has seen', _is_search),
    'seen': ('a whole number from 1 on', lambda value: _count(value, 1)),
}


def _require(good: Any, message: str):
    if not good:
        raise InputError(message)
