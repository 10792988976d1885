"""A fit's state on the device, and its transfer to and from the host."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting.state import State
from lingo_mi.projectors.upload import uploaded


def _types() -> dict[str, Any]:
    return dict(
        centre=mi.Point3f,
        scale=mi.Vector3f,
        rotation=mi.Vector4f,
        density=mi.Float,
        opacity=mi.Float,
        radiance=mi.Float,
        harmonics=mi.ArrayXf,
        features=mi.Float,
        network=mi.Float,
    )


class DeviceState:
    """`state.State` in Dr.Jit arrays: `values`, `first`, `second` by name; `gradient`, `visits` Float [N]."""

    def __init__(self, state: State):
        self.values, self.first, self.second = upload(state.values), upload(state.first), upload(state.second)
        self.gradient, self.visits = uploaded(state.gradient), uploaded(state.visits)
        self.born = state.born

    def __len__(self) -> int:
        return len(self.born)

    def host(self) -> State:
        """The state as NumPy arrays."""
        return State(
            download(self.values),
            download(self.first),
            download(self.second),
            self.gradient.numpy(),
            self.visits.numpy(),
            self.born,
        )

    def finite(self) -> bool:
        """Return whether all parameters are finite; waits for the device."""
        totals: dict[int, Any] = {}  # by width: all parameters of the Gaussians have the same
        for x in self.values.values():
            total = x if isinstance(x, mi.Float) else dr.sum(x)
            totals[dr.width(total)] = totals.get(dr.width(total), 0) + total
        return all(bool(dr.all(dr.isfinite(total))) for total in totals.values())


def upload(columns: dict) -> dict:
    """Parameters by name, float32 [N, components], as Dr.Jit's types."""
    types = _types()
    return {k: types[k](*(uploaded(c) for c in v.T)) for k, v in columns.items()}


def download(columns: dict) -> dict:
    """The inverse of `upload`."""
    # By component: interleaving a whole vector takes a kernel with the vector's length compiled in.
    return {k: np.stack([c.numpy() for c in ([x] if isinstance(x, mi.Float) else x)], 1) for k, x in columns.items()}
