"""The settings of a fit and the three recipes: every number named, with its source."""
from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from ..errors import InputError


@dataclass(frozen=True)
class Settings:
    """What a fit does. Lengths are in the normalised frame, where the volume's longest side is 2; `rate_*` are Adam's step
    sizes (first, last), decayed log-linearly. Defaults are R2-Gaussian's published values.

    Length of the run
    iterations         Adam steps
    decay_steps        iterations over which the rates fall from first to last; 0 stands for `iterations`
    batch              views a step
    coarse_share       share of the iterations, the first ones, that see views binned 2 x 2 (own): a quarter of the pixels
    checkpoint_seconds how often a checkpoint is written

    Start
    init               'lingo' (paper, section III-A and B) or 'r2' (an FDK volume)
    n_points           Gaussians to start with (paper: 50k)
    high_fraction, low_factor, occupancy_voxels, V_S, misses, outside, init_density
                       of `lingo`: see `lingo_mi.lingo.initialise.Settings`; the density 'fdk' becomes 'lsq' where FDK
                       cannot reconstruct (poses off the circle, invalid pixels)
    fdk_threshold, fdk_rescale
                       of `r2`: see `lingo_mi.fit.r2_init` (R2: 0.05 and 0.15)
    normalise          whether densities are fitted in a unit that makes the largest line integral 1 (own): SSIM's
                       constants and the bounds then mean the same for any object; R2 expects volumes in [0, 1]

    Forward model
    extent             cut-off in standard deviations (R2: 3)
    effects            'model': where a scan has effects (spectrum, focal spot, blur, dead pixels), the cloud is seen through
                       them, since a scene that names them says how its data came about; or 'ignore': projections are
                       taken for line integrals whatever the scene says

    Loss (paper, section III-C)
    lambda_ssim        weight of 1 - SSIM (0.25)
    lambda_tv          weight of the total variation of a random cube (0.05)
    tv_size            voxels along its sides (32)
    weights            'equal', or 'noise' (own): an image and the measured one are compared after each pixel is divided by
                       the standard deviation of its noise, as the scan's `ct_detector` says it is
    loss_scale         'none'; 'dynamic', the paper's T_g + 1 / (4 T_g) on the whole loss; or 'statistic', the same
                       factor on the densification statistic alone (Adam cancels a constant factor anyway)

    Adam
    rate_centre, rate_density, rate_scale, rate_rotation
    rate_pose          of the corrections to every view's pose (own): radians, and units of half the volume's longest side;
                       0, 0 leaves the poses alone (see `lingo_mi.fit.poses`)
    beta1, beta2       decay of the moments (R2: Adam's usual 0.9 and 0.999)
    epsilon            added to the root of the second moment (R2: 1e-15)

    Densification
    densify_from, densify_until, densify_every   iterations (500, 15000, 100)
    densify_threshold  mean gradient of the projected centre, in normalised device units (5e-5)
    split_size         Gaussians with a larger standard deviation split, others clone (R2: 0.1 of the longest side)
    split_keeps_mass   whether the halves of a split weigh what their parent did (R2: no)
    prune_density      Gaussians below vanish, as do those outside the volume (1e-5)
    max_gaussians      no densification beyond (500k)
    values_per_gaussian
                       measured values that there must be for each Gaussian (own; 0: any number): bounds the Gaussians at
                       the start and later, since a small scan cannot determine many

    Bounds
    scale_min, scale_max   standard deviations (R2: 5e-4 and 0.5 of the longest side)
    """

    iterations: int = 30_000
    decay_steps: int = 30_000
    batch: int = 1
    coarse_share: float = 0.
    checkpoint_seconds: float = 30.
    init: str = 'r2'
    n_points: int = 50_000
    high_fraction: float = .25
    low_factor: float = .1
    occupancy_voxels: int = 16
    V_S: float = 20.
    misses: int = 0
    outside: str = 'invalid'
    init_density: str = 'lsq'
    fdk_threshold: float = .05
    fdk_rescale: float = .15
    normalise: bool = False
    extent: float = 3.
    effects: str = 'model'
    lambda_ssim: float = .25
    lambda_tv: float = .05
    tv_size: int = 32
    weights: str = 'equal'
    loss_scale: str = 'none'
    rate_centre: tuple[float, float] = (2e-4, 2e-5)
    rate_density: tuple[float, float] = (1e-2, 1e-3)
    rate_scale: tuple[float, float] = (5e-3, 5e-4)
    rate_rotation: tuple[float, float] = (1e-3, 1e-4)
    rate_pose: tuple[float, float] = (0., 0.)
    beta1: float = .9
    beta2: float = .999
    epsilon: float = 1e-15
    densify_from: int = 500
    densify_until: int = 15_000
    densify_every: int = 100
    densify_threshold: float = 5e-5
    split_size: float = .2
    split_keeps_mass: bool = False
    prune_density: float = 1e-5
    max_gaussians: int = 500_000
    values_per_gaussian: float = 0.
    scale_min: float = 1e-3
    scale_max: float = 1.

    def __post_init__(self):
        def require(good, message):
            if not good:
                raise InputError(message)
        for f in fields(self):
            value = getattr(self, f.name)
            require(isinstance(value, str) or all(math.isfinite(x) for x in (value if isinstance(value, tuple) else [value])),
                    f'{f.name} must be finite, not {value}')
        require(self.iterations >= 1, f'iterations must be at least 1, not {self.iterations}')
        require(self.batch >= 1, f'batch must be at least 1, not {self.batch}')
        require(0 <= self.beta1 < 1 and 0 <= self.beta2 < 1, 'beta1 and beta2 must lie in [0, 1)')
        require(self.checkpoint_seconds >= 0, f'checkpoint_seconds must not be negative, not {self.checkpoint_seconds:g}')
        require(0 <= self.coarse_share <= 1, f'coarse_share must lie in [0, 1], not {self.coarse_share:g}')
        require(self.init in ('lingo', 'r2'), f"init is 'lingo' or 'r2', not {self.init!r}")
        require(self.outside in ('invalid', 'ignore', 'auto'),
                f"outside is 'invalid', 'ignore' or 'auto', not {self.outside!r}")
        require(self.n_points >= 1, f'n_points must be at least 1, not {self.n_points}')
        require(self.loss_scale in ('none', 'dynamic', 'statistic'),
                f"loss_scale is 'none', 'dynamic' or 'statistic', not {self.loss_scale!r}")
        require(self.weights in ('equal', 'noise'), f"weights is 'equal' or 'noise', not {self.weights!r}")
        require(self.max_gaussians >= 1, f'max_gaussians must be at least 1, not {self.max_gaussians}')
        require(self.values_per_gaussian >= 0,
                f'values_per_gaussian must not be negative, not {self.values_per_gaussian:g}')
        require(1 <= self.extent <= 20, f'extent is from 1 to 20 standard deviations, not {self.extent:g}')
        require(self.effects in ('model', 'ignore'), f"effects is 'model' or 'ignore', not {self.effects!r}")
        require(0 < self.scale_min < self.scale_max, 'scale_min must be positive and below scale_max')
        require(self.densify_every >= 1, f'densify_every must be at least 1, not {self.densify_every}')
        for name in ('rate_centre', 'rate_density', 'rate_scale', 'rate_rotation'):
            rate = getattr(self, name)
            require(len(rate) == 2 and min(rate) > 0, f'{name} must be two positive numbers, first and last, not {rate}')
        require(len(self.rate_pose) == 2 and (min(self.rate_pose) > 0 or self.rate_pose == (0, 0)),
                f'rate_pose must be two positive numbers, first and last, or 0, not {self.rate_pose}')

    def rate(self, name: str, iteration: int) -> float:
        """Adam's step size for 'centre', 'density', 'scale', 'rotation' or 'pose' at an iteration, counted from 0."""
        first, last = getattr(self, f'rate_{name}')
        share = min(iteration / max(self.decay_steps or self.iterations, 1), 1.)
        return first ** (1 - share) * last ** share

    def changed(self, **values) -> Settings:
        """These settings with some of them replaced; values may be strings, as from a command line.

        Raises InputError for an unknown name or a value of the wrong kind.
        """
        known = {f.name: getattr(self, f.name) for f in fields(self)}
        parsed = {}
        for name, value in values.items():
            if name not in known:
                raise InputError(f'unknown setting {name!r}: one of {", ".join(known)}')
            parsed[name] = _parse(name, value, known[name])
        return replace(self, **parsed)


def _parse(name, value, like):
    if not isinstance(value, str):
        return value
    try:
        if isinstance(like, tuple):
            numbers = tuple(float(x) for x in value.split(','))
            return numbers * 2 if len(numbers) == 1 else numbers
        if isinstance(like, bool):
            return {'true': True, 'false': False}[value.lower()]
        if isinstance(like, int) and float(value) != int(float(value)):
            raise ValueError
        return int(float(value)) if isinstance(like, int) else type(like)(value)
    except (ValueError, KeyError):
        kind = {bool: 'true or false', int: 'a whole number', float: 'a number', tuple: 'two numbers, first,last'}[type(like)]
        raise InputError(f'setting {name} must be {kind}, not {value!r}') from None


R2 = Settings()
LINGO = Settings(init='lingo', loss_scale='dynamic')
# Found by measurement on the foot and chest phantoms. Against LINGO: densities that start from an FDK volume, rates up to 40
# times higher that fall over the run, moments that forget faster, more weight on SSIM, which brings fine detail forward,
# and earlier densification, as far as the scan's size allows.
FAST = Settings(
    init='lingo', init_density='fdk', outside='auto', normalise=True, iterations=1500, decay_steps=0,
    lambda_ssim=1.5, lambda_tv=.1,
    rate_centre=(1e-3, 5e-5), rate_density=(5e-2, 3e-3), rate_scale=(1.5e-1, 5e-3), rate_rotation=(2e-2, 1e-3),
    beta1=.8, beta2=.95, densify_from=150, densify_until=800, densify_every=50, densify_threshold=1e-4,
    split_keeps_mass=True, values_per_gaussian=20)

METHODS = {'fast': FAST, 'lingo': LINGO, 'r2': R2}
