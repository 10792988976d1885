"""Checks for users: derivatives, accuracy, speed, and the paper's tables. The library does not need them.

What is measured, each by a command of `lingo_mi.cli`:

- `accuracy`: error against time, for all ways to compute the same projections
- `benchmark`: the integrator's times against a kernel written by hand and Mitsuba's tree
- `gradient_check`: the derivatives of a scene's image against finite differences
- `tables`: the paper's tables

What it is measured against, and written down with:

- `oracle`, `closed_form`: float64 references of clouds, by differences and by hand
- `alternatives`: other ways to compute the projections of a cloud
- `cuda_model`: the time on a graphics card that follows from counted instructions
- `pairs`: how much work an image is
- `markdown`, `provenance`: tables in documents, and how they were made
"""
