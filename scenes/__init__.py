"""Mitsuba scenes that come with the package, installed as `lingo_mi.scenes`; `lingo_mi.scene.shipped` finds them by name."""
