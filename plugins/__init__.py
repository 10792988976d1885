"""The plugins that Mitsuba knows by name, a file each. They are installed as `lingo_mi.plugins`.

A class that derives from a Mitsuba class belongs to one variant, so every file here is loaded anew for each variant.
"""

from __future__ import annotations

import importlib
import sys
from functools import partial, update_wrapper
from typing import Any

import mitsuba as mi

from lingo_mi.common.errors import InputError

# plugin name -> (module, what to call with it and with the plugin's constructor)
PLUGINS = {
    'lingo_xray': ('lingo_xray', 'register_integrator'),
    'ct_scanner': ('ct_scanner', 'register_sensor'),
    'ct_volume': ('ct_volume', 'register_medium'),
    'xray_tube': ('xray_tube', 'register_emitter'),
    'ct_detector': ('ct_detector', 'register_film'),
    'klein_nishina': ('klein_nishina', 'register_phase'),
    'ct_beam': ('ct_beam', 'register_emitter'),
}


def register() -> None:
    """Register all plugins with the active variant: if it has no derivatives, a stub says which variants have."""
    works = 'ad' in (mi.variant() or '').split('_')
    for name, (module, registrar) in PLUGINS.items():
        if not works:
            getattr(mi, registrar)(name, partial(_refuse, name))
            continue
        path = f'{__name__}.{module}'
        loaded = importlib.reload(sys.modules[path]) if path in sys.modules else importlib.import_module(path)
        getattr(mi, registrar)(name, loaded.create)


def _refuse(name: str, *_: Any) -> None:
    raise InputError(
        f'{name} does not work in {mi.variant()}: call mitsuba.set_variant with llvm_ad_mono, llvm_ad_rgb, cuda_ad_mono or '
        'cuda_ad_rgb before the scene is loaded'
    )


def render(*args: Any, **kwargs: Any) -> Any:
    """Mitsuba's `render`, whose last line of a traceback is the InputError of a plugin, not that Dr.Jit met one."""
    try:
        return mi.util.render(*args, **kwargs)
    except RuntimeError as error:
        if isinstance(error.__cause__, InputError):
            raise error.__cause__ from None
        raise


def watch_variants() -> None:
    """Register the plugins with the active variant, and again with whichever is set later."""

    def on_variant(*_):
        if mi.variant() is not None:
            register()
            mi.render = update_wrapper(render, mi.util.render)  # with its signature and help

    mi.detail.add_variant_callback(on_variant)
    on_variant()
