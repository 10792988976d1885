"""The recipes: published settings and this project's own."""

from __future__ import annotations

import re
from typing import Any

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.settings import Settings

# Zha et al., "R2-Gaussian: Rectifying Radiative Gaussian Splatting for Tomographic Reconstruction", NeurIPS 2024.
R2 = Settings()
LINGO = R2.changed(init='lingo', loss_scale='dynamic')
# Tuned on the foot and chest phantoms and the engine. Differences from R2: a start on the edges of a quick reconstruction; no
# factor on the loss, and the gradient of the difference beside L1, which restores fine detail sooner; rates 3 to 40 times higher
# that fall over the run; views in a row that lie well apart; Nesterov's momentum, a shorter memory of the second moment, and a
# mean of the last steps; more weight on SSIM; total variation of eight times the volume (with a short memory, each Gaussian must
# be smoothed more often than once in 64 steps), less for more views; early densification, limited by the scan's size; an early
# stop where the noise is known.
FAST = R2.changed(
    init='edges',
    normalise=True,
    iterations=600,
    decay_steps=0,
    view_order='golden',
    lambda_ssim=1.0,
    lambda_gradient=3.0,
    lambda_tv=0.4,
    tv_stride=2,
    tv_views=25,
    rate_centre=(2e-3, 7e-5),
    rate_density=(2e-1, 6e-3),
    rate_scale=(2e-1, 5e-3),
    rate_rotation=(2e-2, 1e-3),
    beta1=0.96,
    beta2=0.97,
    nesterov=True,
    average=0.97,
    densify_from=50,
    densify_until=300,
    densify_every=25,
    densify_threshold=1e-4,
    birth='halve',
    values_per_gaussian=14,
    stop='auto',
)

# Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", ACM TOG 42 (2023), and its released settings, on
# grey images. Its loss 0.8 L1 + 0.2 (1 - SSIM) is 0.8 times the one here, so a gradient of 2e-4 there is 2.5e-4 here. Its
# scales are unbounded; the bounds here keep them where float32 and the footprints are valid.
GS3D = R2.changed(
    render='alpha',
    init='random',
    n_points=100_000,
    normalise=True,
    effects='ignore',
    extent=3.33,
    lambda_tv=0.0,
    rate_centre=(1.6e-4, 1.6e-6),
    rate_scale=(5e-3, 5e-3),
    rate_rotation=(1e-3, 1e-3),
    densify_threshold=2.5e-4,
    split_size=0.01,
    prune_density=5e-3,
    reset_every=3000,
    scale_min=1e-5,
)
# Cai et al., "Radiative Gaussian Splatting for Efficient X-ray Novel View Synthesis", ECCV 2024: the same radiance in all
# directions, a start from the cuboid, and the released settings of its foot scan (threshold 2.7e-5 for 3DGS's loss). Its code
# divides every view by its own maximum; here one maximum is taken for all, so that views stay comparable.
XGAUSSIAN = GS3D.changed(
    init='cuboid',
    sh_degree=0,
    iterations=20_000,
    decay_steps=20_000,
    rate_centre=(1.79e-4, 1.79e-6),
    rate_radiance=(2e-3, 2e-3),
    rate_opacity=(6e-3, 6e-3),
    densify_until=8000,
    densify_every=800,
    densify_threshold=3.375e-5,
    split_size=0.008,
    reset_every=1200,
)

# Zha, Zhang and Li, "NAF: Neural Attenuation Fields for Sparse-View CBCT Reconstruction", MICCAI 2022, and its released
# settings of the chest: 1500 passes over 50 views. The rates step down to a tenth in the paper, and not at all in these released
# settings; here they fall to it log-linearly. Rays are sampled within the volume alone, there between two distances that are
# the same for all rays and reach beyond it. Its lengths are metres, and Adam's epsilon is 1e-8. In the normalised frame of a
# volume of 256 mm the gradients are (1000 * 2 / 256)^2 = 61 times as large, and so is epsilon. The unit of density and the
# start are our own.
NAF = R2.changed(
    render='field',
    init='network',
    normalise=True,
    field_start='mean',
    effects='ignore',
    iterations=75_000,
    decay_steps=0,
    lambda_ssim=0.0,
    lambda_tv=0.0,
    epsilon=6e-7,
)

METHODS = {'fast': FAST, 'lingo': LINGO, 'r2': R2, '3dgs': GS3D, 'xgaussian': XGAUSSIAN, 'naf': NAF}
CLOUDS = tuple(name for name, s in METHODS.items() if s.cloud and s.volumetric)  # those of Gaussians with densities


def settings_of(method: str, **values: Any) -> Settings:
    """The settings of the recipe `name` or `name:setting=value,...`. `values` replace the recipe's own settings; those in the
    name take precedence.

    Raises InputError for an unknown method or setting.

    Example: `settings_of('lingo:V_S=1,rate_density=1e-2,1e-3', iterations=800)`.
    """
    name, _, changes = method.partition(':')
    if name not in METHODS:
        raise InputError(f'{method}: there is no such recipe; use one of {", ".join(METHODS)}')
    own = {setting: value for setting, _, value in (change.partition('=') for change in changes_of(changes))}
    return METHODS[name].changed(**values).changed(**own)


def changes_of(text: str) -> list[str]:
    """'setting=value,...' one by one. Not every comma ends a setting: rates are two numbers."""
    return [change for change in re.split(r',(?=\w+=)', text) if change]
