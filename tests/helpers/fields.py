"""Small neural fields."""

import numpy as np

from lingo_mi.fitting.methods.naf import NAF

SMALL = NAF().changed(
    iterations=12,
    field_levels=4,
    field_entries=2**10,
    field_base=4,
    field_cube=1.25,
    field_width=8,
    field_samples=24,
    field_rays=64,
    rate_features=(1e-2, 1e-3),
    rate_network=(1e-2, 1e-3),
)


def random_state(method, seed=0, amplitude=0.5):
    """A state with features that are far from 0, so that the field varies."""
    from lingo_mi.fitting.field.network import Network
    from lingo_mi.fitting.state import State

    rng = np.random.default_rng(seed)
    values = Network(method.field).initial(rng)
    values['features'] = rng.uniform(-amplitude, amplitude, values['features'].shape).astype(np.float32)
    zeros = {k: np.zeros_like(v) for k, v in values.items()}
    return State(
        values,
        zeros,
        {k: v.copy() for k, v in zeros.items()},
        *(np.zeros(0, np.float32) for _ in range(2)),
        np.zeros(0, bool),
    )
