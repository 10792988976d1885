"""What Mitsuba knows by name, one plugin a file. Installed as `lingo_mi.plugins`.

A class that derives from a Mitsuba class belongs to one variant, so every file here is loaded anew for each variant.
"""

import importlib
import sys

import mitsuba as mi

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
    """Register all plugins with the active variant."""
    for name, (module, registrar) in PLUGINS.items():
        path = f'{__name__}.{module}'
        loaded = importlib.reload(sys.modules[path]) if path in sys.modules else importlib.import_module(path)
        getattr(mi, registrar)(name, loaded.create)


def watch_variants() -> None:
    """Register the plugins with the active variant, and again with whichever is set later."""

    def on_variant(*_):
        variant = mi.variant()
        if variant is not None and 'ad' in variant.split('_'):
            register()

    mi.detail.add_variant_callback(on_variant)
    on_variant()
