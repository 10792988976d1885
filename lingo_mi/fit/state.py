"""The state of a fit: everything that a step changes, and how raw parameters become Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lingo_mi.fit.settings import Settings

PARAMETERS = {'centre': 3, 'scale': 3, 'rotation': 4, 'density': 1}
OPACITY = 0.1  # of all Gaussians at the start of a fit by alpha compositing (3DGS)


def parameters(settings: Settings) -> dict[str, int]:
    """The raw parameters of a Gaussian by name, and how many numbers each is.

    `PARAMETERS`; for alpha compositing 'opacity' and 'radiance' in place of the density, and 'harmonics', coefficients of the
    radiance's spherical harmonics from degree 1 on, degree by degree.
    """
    if settings.volumetric:
        return PARAMETERS
    harmonics = {'harmonics': (settings.model.sh_degree + 1) ** 2 - 1} if settings.model.sh_degree else {}
    return {'centre': 3, 'scale': 3, 'rotation': 4, 'opacity': 1, 'radiance': 1} | harmonics


@dataclass
class State:
    """N Gaussians under optimisation, on the host: NumPy arrays, float32 but for `born`.

    values             raw parameters by name, [N, size]; see `parameters` and `activate`
    first, second      Adam's moments, like `values`
    gradient, seen     densification statistic: summed norms of the projected centre's gradient, and how often [N]
    born               whether a Gaussian came from a clone or a split [N]
    """

    values: dict[str, np.ndarray]
    first: dict[str, np.ndarray]
    second: dict[str, np.ndarray]
    gradient: np.ndarray
    seen: np.ndarray
    born: np.ndarray = field(repr=False)

    def __len__(self) -> int:
        return len(self.born)


def start(points, spacing, density, settings: Settings) -> State:
    """The state that begins a fit: isotropic Gaussians, unrotated, without moments.

    points [N, 3], spacing [N] standard deviations, density [N] at the centres, in the fit's unit; normalised frame. For
    alpha compositing, without density: opacities of 0.1 and half grey (3DGS).
    """
    scale_min, scale_max = settings.bounds.scale_min, settings.bounds.scale_max
    n = len(points)
    scale = np.clip(spacing, scale_min + 1e-5, scale_max - 1e-5)[:, None].repeat(3, 1)
    values = dict(
        centre=np.asarray(points),
        scale=inverse_scale(scale, scale_min, scale_max),
        rotation=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
    )
    if settings.volumetric:
        values['density'] = inverse_softplus(np.asarray(density))[:, None]
    else:
        values['opacity'] = np.full((n, 1), inverse_sigmoid(OPACITY))
        values |= {k: np.zeros((n, size)) for k, size in parameters(settings).items() if k not in values}
    values = {k: np.ascontiguousarray(v, np.float32) for k, v in values.items()}
    zeros = {k: np.zeros_like(v) for k, v in values.items()}
    return State(
        values,
        zeros,
        {k: v.copy() for k, v in zeros.items()},
        np.zeros(n, np.float32),
        np.zeros(n, np.float32),
        np.zeros(n, bool),
    )


def activate(state: State, settings: Settings):
    """Centres, standard deviations, unit quaternions (x, y, z, w) and densities or opacities, float64 [N, ...].

    Scales by a sigmoid between the bounds, densities by softplus: both R2-Gaussian's. Opacities by a sigmoid (3DGS).
    """
    scale_min, scale_max = settings.bounds.scale_min, settings.bounds.scale_max
    v = {k: x.astype(float) for k, x in state.values.items()}
    rotation = v['rotation'] / np.linalg.norm(v['rotation'], axis=1, keepdims=True)
    scale = scale_min + (scale_max - scale_min) / (1 + np.exp(-v['scale']))
    amount = softplus(v['density'][:, 0]) if 'density' in v else 1 / (1 + np.exp(-v['opacity'][:, 0]))
    return v['centre'], scale, rotation, amount


def harmonics(state: State):
    """Coefficients of the radiance's spherical harmonics: of degree 0 [N], to whose harmonic 1/2 is added, and higher [N, M].

    Radiance that is the same in all directions is a sigmoid of its raw value (see `projectors.radiance`).
    """
    raw = state.values['radiance'][:, 0].astype(float)
    if 'harmonics' in state.values:
        return raw, state.values['harmonics']
    return np.sqrt(4 * np.pi) * (1 / (1 + np.exp(-raw)) - 0.5), np.zeros((len(raw), 0))


def softplus(x):
    """ln(1 + e^x), without overflow."""
    return np.logaddexp(0.0, x)


def inverse_softplus(y):
    """x with softplus(x) = y; y below 1e-30 counts as that, since 0 has no inverse."""
    y = np.maximum(y, 1e-30)
    return y + np.log(-np.expm1(-y))


def inverse_scale(scale, low: float, high: float):
    """Raw scale of a standard deviation strictly between the bounds."""
    return inverse_sigmoid((scale - low) / (high - low))


def inverse_sigmoid(y):
    """x with 1 / (1 + e^-x) = y, for y in (0, 1)."""
    return np.log(y) - np.log1p(-y)
