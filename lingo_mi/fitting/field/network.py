"""The neural attenuation field: a multiresolution hash grid and a small network, by Dr.Jit's `drjit.nn`.

Zha, Zhang and Li, "NAF: Neural Attenuation Fields for Sparse-View CBCT Reconstruction", MICCAI 2022; the encoding is by Müller
et al., "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding", ACM TOG 41 (2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit import nn

from lingo_mi.fitting.activations import inverse_sigmoid
from lingo_mi.fitting.field.options import Field

SLOPE = 0.01  # of the leaky ReLU below 0 (PyTorch's default)
MEANS = 1e-4, 0.5  # densities that a field starts from: it hardly leaves lower ones
FEATURE_RANGE = 1e-4  # features begin uniform within it (Müller et al., section 4)


class Network:
    """Density as a function of the position, with its parameters given at every call.

    - `features`: of the hash grid, Float: `field_features` numbers an entry, level by level
    - `network`: matrices and biases of the layers, Float: matrix, row by row, then bias, layer by layer

    The matrices multiply a tensor of all points (`drjit.nn.Linear` on tensors). Cooperative vectors would do the same within
    one kernel, but their derivatives by the matrices take four times as long on the CPU.
    """

    def __init__(self, options: Field):
        s = options
        self.encoding: Any = nn.HashGridEncoding(
            mi.Float,
            3,
            n_levels=s.field_levels,
            n_features_per_level=s.field_features,
            hashmap_size=s.field_entries,
            base_resolution=s.field_base,
            per_level_scale=s.field_growth,
        )
        self.inputs, width = self.encoding.n_output_features, s.field_width
        sizes = [self.inputs, *[width] * (s.field_layers - 1)]
        self.layers = [(n + self.inputs if i == s.field_skip else n, width) for i, n in enumerate(sizes)]
        self.layers[-1] = self.layers[-1][0], 1
        self.skip = s.field_skip
        self.count = sum(n * m + m for n, m in self.layers)

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Shapes of the parameters by name, as columns."""
        return {'features': (self.encoding.n_params, 1), 'network': (self.count, 1)}

    def initial(self, rng: np.random.Generator, mean: float | None = None) -> dict[str, np.ndarray]:
        """Random parameters, float32, of the shapes `shapes`.

        Features are uniform in +-1e-4, matrices and biases in +-1 / sqrt(inputs of the layer), PyTorch's default. With a `mean`,
        the last bias is such that the field is about as dense everywhere.
        """
        features = rng.random(self.encoding.n_params, np.float32) * np.float32(2 * FEATURE_RANGE) - np.float32(
            FEATURE_RANGE
        )
        network = np.concatenate([rng.uniform(-1, 1, n * m + m) / np.sqrt(n) for n, m in self.layers])
        if mean is not None:
            network[-1] = inverse_sigmoid(np.clip(mean, *MEANS))
        return {'features': features[:, None], 'network': network.astype(np.float32)[:, None]}

    def density(self, values: dict[str, Any], points: Sequence[Any]) -> Any:
        """The field at points, Float [N], in (0, 1). Differentiable by the parameters, which `values` has by name.

        Parameters
        ----------
        points : Sequence[Any]
            X, y, z, Float [N] each, in [0, 1].
        """
        self.encoding.data = values['features']
        encoded: Any = dr.ravel(self.encoding(points), order='C')
        inputs = mi.TensorXf(encoded, (self.inputs, dr.width(points)))
        hidden, begin = inputs, 0
        for i, (n, m) in enumerate(self.layers):
            bias = _block(values['network'], begin + n * m, 1, (m, 1))
            if i == self.skip:  # the product with both halves of the matrix, so that the inputs need not be joined
                k = self.inputs
                left, right = (_block(values['network'], begin + a, n, (m, b)) for a, b in ((0, k), (k, n - k)))
                hidden = left @ inputs + right @ hidden + bias
            else:
                hidden = _block(values['network'], begin, n, (m, n)) @ hidden + bias
            begin += n * m + m
            if i < len(self.layers) - 1:
                hidden = dr.select(hidden > 0, hidden, hidden * SLOPE)
        return 1 / (1 + dr.exp(-hidden.array))


def _block(values: Any, begin: int, stride: int, shape: tuple[int, int]) -> Any:
    """A block of a matrix that is stored in a Float row by row, `stride` numbers a row.

    Slices of the whole matrix gave derivatives of 0 here, in Dr.Jit 1.5.0."""
    rows, columns = shape
    index = dr.arange(mi.UInt32, rows * columns)
    row = index // columns
    place = row * stride + (index - row * columns) + dr.opaque(mi.UInt32, begin)
    return mi.TensorXf(dr.gather(mi.Float, values, place, mode=dr.ReduceMode.NoConflicts), shape)
