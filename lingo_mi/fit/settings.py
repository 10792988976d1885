"""The settings of a fit and the recipes: every number named, with its source."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from lingo_mi.errors import InputError
from lingo_mi.lingo import initialise as lingo
from lingo_mi.parsing import parse
from lingo_mi.projectors import cutoff


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
    init               'lingo' (paper, section III-A and B) or 'r2' (an FDK volume); for alpha compositing 'random' (points in
                       the volume, as 3DGS where it has no others) or 'cuboid' (X-Gaussian's regular grid)
    n_points           Gaussians to start with (paper: 50k)
    cuboid_step        voxels between the points of `cuboid` (X-Gaussian: 8)
    high_fraction, low_factor, occupancy_voxels, V_S, misses, outside, init_density
                       of `lingo`: see `lingo_mi.lingo.initialise.Settings`; the density 'fdk' becomes 'lsq' where FDK
                       cannot reconstruct (a source off the circle, a panel that moves against it, invalid pixels)
    fdk_threshold, fdk_rescale
                       of `r2`: see `lingo_mi.fit.r2_start` (R2: 0.05 and 0.15)
    normalise          whether densities are fitted in a unit that makes the largest line integral 1 (own): SSIM's
                       constants and the bounds then mean the same for any object; R2 expects volumes in [0, 1]

    Forward model
    render             'integral': pixels are line integrals; or 'alpha': grey images, the projections over their maximum, are
                       composited front to back from opacities and radiances (3DGS, see `lingo_mi.projectors.alpha`), which
                       makes no volume. For the latter `rate_centre`, `split_size` and `prune_size` are in units of the
                       scene's radius (see `lingo_mi.fit.loop.scene_radius`)
    sh_degree          of `alpha`: degree of the radiance's spherical harmonics, at most 3 (3DGS: 3); 0 for radiance that is the
                       same in all directions (X-Gaussian)
    sh_every           iterations after which another degree joins in (3DGS: 1000)
    extent             cut-off in standard deviations (R2: 3)
    effects            'model': where a scan has effects (spectrum, focal spot, blur, dead pixels), the cloud is seen through
                       them, since a scene that names them says how its data came about; or 'ignore': projections are
                       taken for line integrals whatever the scene says

    Loss (paper, section III-C)
    lambda_ssim        weight of 1 - SSIM (0.25)
    lambda_tv          weight of the total variation of a random cube (0.05)
    tv_size            samples along its sides (32)
    tv_stride          voxels from sample to sample (own: 2 smooths eight times the volume at the same cost; published: 1)
    weights            'equal', or 'noise' (own): an image and the measured one are compared after each pixel is divided by
                       the standard deviation of its noise, as the scan's `ct_detector` says it is
    loss_scale         'none'; 'dynamic', the paper's T_g + 1 / (4 T_g) on the whole loss; or 'statistic', the same
                       factor on the densification statistic alone (Adam cancels a constant factor anyway)

    Adam
    rate_centre, rate_density, rate_scale, rate_rotation
    rate_opacity, rate_radiance, rate_harmonics
                       of `alpha`, instead of `rate_density` (3DGS: 0.05, 0.0025, and a twentieth of that, none of which fall)
    rate_pose          of the corrections to every view's pose (own): radians, and units of half the volume's longest side;
                       0, 0 leaves the poses alone (see `lingo_mi.fit.poses`)
    beta1, beta2       decay of the moments (R2: Adam's usual 0.9 and 0.999)
    epsilon            added to the root of the second moment (R2: 1e-15)
    average            decay of the running mean of the parameters which is the result (own); 0: those of the last step

    Densification
    densify_from, densify_until, densify_every   iterations (500, 15000, 100)
    densify_threshold  mean gradient of the projected centre, in normalised device units (5e-5)
    birth              'clone': the small are cloned and the large split (R2); 'halve': all are cut in two along their longest
                       axis, which keeps mass and covariance (own): see `lingo_mi.fit.densify`
    split_size         of `clone`: Gaussians with a larger standard deviation split (R2: 0.1 of the longest side)
    prune_density      Gaussians below vanish, as do those outside the volume (1e-5); of `alpha` an opacity, and Gaussians
                       outside stay (3DGS: 0.005)
    reset_every        of `alpha`: iterations after which opacities are lowered to 0.01, while densification lasts (3DGS: 3000);
                       0: never
    prune_size         of `alpha`: Gaussians with a larger standard deviation vanish after the first reset (3DGS: 0.1)
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
    coarse_share: float = 0.0
    checkpoint_seconds: float = 30.0
    init: str = 'r2'
    n_points: int = 50_000
    cuboid_step: int = 8
    high_fraction: float = 0.25
    low_factor: float = 0.1
    occupancy_voxels: int = 16
    V_S: float = 20.0
    misses: int = 0
    outside: str = 'invalid'
    init_density: str = 'lsq'
    fdk_threshold: float = 0.05
    fdk_rescale: float = 0.15
    normalise: bool = False
    render: str = 'integral'
    sh_degree: int = 3
    sh_every: int = 1000
    extent: float = cutoff.FIT
    effects: str = 'model'
    lambda_ssim: float = 0.25
    lambda_tv: float = 0.05
    tv_size: int = 32
    tv_stride: int = 1
    weights: str = 'equal'
    loss_scale: str = 'none'
    rate_centre: tuple[float, float] = (2e-4, 2e-5)
    rate_density: tuple[float, float] = (1e-2, 1e-3)
    rate_scale: tuple[float, float] = (5e-3, 5e-4)
    rate_rotation: tuple[float, float] = (1e-3, 1e-4)
    rate_opacity: tuple[float, float] = (5e-2, 5e-2)
    rate_radiance: tuple[float, float] = (2.5e-3, 2.5e-3)
    rate_harmonics: tuple[float, float] = (1.25e-4, 1.25e-4)
    rate_pose: tuple[float, float] = (0.0, 0.0)
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-15
    average: float = 0.0
    densify_from: int = 500
    densify_until: int = 15_000
    densify_every: int = 100
    densify_threshold: float = 5e-5
    birth: str = 'clone'
    split_size: float = 0.2
    prune_density: float = 1e-5
    reset_every: int = 0
    prune_size: float = 0.1
    max_gaussians: int = 500_000
    values_per_gaussian: float = 0.0
    scale_min: float = 1e-3
    scale_max: float = 1.0

    def __post_init__(self):
        def require(good, message):
            if not good:
                raise InputError(message)

        for f in fields(self):
            value = getattr(self, f.name)
            require(
                isinstance(value, str)
                or all(math.isfinite(x) for x in (value if isinstance(value, tuple) else [value])),
                f'{f.name} must be finite, not {value}',
            )
        require(self.iterations >= 1, f'iterations must be at least 1, not {self.iterations}')
        require(self.batch >= 1, f'batch must be at least 1, not {self.batch}')
        require(0 <= self.beta1 < 1 and 0 <= self.beta2 < 1, 'beta1 and beta2 must lie in [0, 1)')
        require(0 <= self.average < 1, f'average must be at least 0 and below 1, not {self.average:g}')
        require(self.birth in ('clone', 'halve'), f"birth is 'clone' or 'halve', not {self.birth!r}")
        require(self.tv_size >= 1 and self.tv_stride >= 1, 'tv_size and tv_stride must be at least 1')
        require(
            self.checkpoint_seconds >= 0, f'checkpoint_seconds must not be negative, not {self.checkpoint_seconds:g}'
        )
        require(0 <= self.coarse_share <= 1, f'coarse_share must lie in [0, 1], not {self.coarse_share:g}')
        require(self.render in ('integral', 'alpha'), f"render is 'integral' or 'alpha', not {self.render!r}")
        inits = ('random', 'cuboid') if self.render == 'alpha' else ('lingo', 'r2')
        require(
            self.init in inits, f'init is {inits[0]!r} or {inits[1]!r} with render={self.render}, not {self.init!r}'
        )
        require(
            self.render == 'integral' or self.normalise and self.lambda_tv == 0 and self.effects == 'ignore',
            'render=alpha composites grey images and knows no densities: it needs normalise=true, lambda_tv=0 and '
            'effects=ignore, as in the method 3dgs',
        )
        require(0 <= self.sh_degree <= 3, f'sh_degree is from 0 to 3, not {self.sh_degree}')
        require(self.sh_every >= 1, f'sh_every must be at least 1, not {self.sh_every}')
        require(self.cuboid_step >= 1, f'cuboid_step must be at least 1, not {self.cuboid_step}')
        require(self.reset_every >= 0, f'reset_every must not be negative, not {self.reset_every}')
        require(self.n_points >= 1, f'n_points must be at least 1, not {self.n_points}')
        require(
            self.loss_scale in ('none', 'dynamic', 'statistic'),
            f"loss_scale is 'none', 'dynamic' or 'statistic', not {self.loss_scale!r}",
        )
        require(self.weights in ('equal', 'noise'), f"weights is 'equal' or 'noise', not {self.weights!r}")
        require(self.max_gaussians >= 1, f'max_gaussians must be at least 1, not {self.max_gaussians}')
        require(
            self.values_per_gaussian >= 0, f'values_per_gaussian must not be negative, not {self.values_per_gaussian:g}'
        )
        require(1 <= self.extent <= 20, f'extent is from 1 to 20 standard deviations, not {self.extent:g}')
        require(self.effects in ('model', 'ignore'), f"effects is 'model' or 'ignore', not {self.effects!r}")
        require(0 < self.scale_min < self.scale_max, 'scale_min must be positive and below scale_max')
        for name in (
            'decay_steps',
            'lambda_ssim',
            'lambda_tv',
            'epsilon',
            'fdk_rescale',
            'densify_from',
            'densify_until',
            'densify_threshold',
            'split_size',
            'prune_density',
            'prune_size',
        ):
            require(getattr(self, name) >= 0, f'{name} must not be negative, not {getattr(self, name):g}')
        require(self.densify_every >= 1, f'densify_every must be at least 1, not {self.densify_every}')
        for name in (
            'rate_centre',
            'rate_density',
            'rate_scale',
            'rate_rotation',
            'rate_opacity',
            'rate_radiance',
            'rate_harmonics',
        ):
            rate = getattr(self, name)
            require(
                len(rate) == 2 and min(rate) > 0, f'{name} must be two positive numbers, first and last, not {rate}'
            )
        require(
            len(self.rate_pose) == 2 and (min(self.rate_pose) > 0 or self.rate_pose == (0, 0)),
            f'rate_pose must be two positive numbers, first and last, or 0, not {self.rate_pose}',
        )

        require(self.occupancy_voxels >= 1, f'occupancy_voxels must be at least 1, not {self.occupancy_voxels}')
        self.of_start()

    def of_start(self) -> lingo.Settings:
        """Those of `lingo.initialise`. Raises InputError."""
        return lingo.Settings(
            n_points=self.n_points,
            high_fraction=self.high_fraction,
            low_factor=self.low_factor,
            resolution=self.occupancy_voxels,
            V_S=self.V_S,
            density=self.init_density,
            misses=self.misses,
            outside=self.outside,
        )

    def rate(self, name: str, iteration: int) -> float:
        """Adam's step size for a parameter (see `lingo_mi.fit.state`) or 'pose' at an iteration, counted from 0."""
        first, last = getattr(self, f'rate_{name}')
        share = min(iteration / max(self.decay_steps or self.iterations, 1), 1.0)
        return first ** (1 - share) * last**share

    def changed(self, **values) -> Settings:
        """These settings with some of them replaced; values may be strings, as from a command line.

        Raises InputError for an unknown name or a value of the wrong kind.
        """
        known = {f.name: getattr(self, f.name) for f in fields(self)}
        parsed = {}
        for name, value in values.items():
            if name not in known:
                raise InputError(f'unknown setting {name!r}: one of {", ".join(known)}')
            parsed[name] = parse(f'setting {name}', value, known[name]) if isinstance(value, str) else value
        return replace(self, **parsed)


R2 = Settings()
LINGO = Settings(init='lingo', loss_scale='dynamic')
# Found by measurement on the foot and chest phantoms. Against LINGO: densities that start from an FDK volume, rates up to 40
# times higher that fall over the run, moments that forget faster and a mean of the last steps, more weight on SSIM, which
# brings fine detail forward, total variation of eight times the volume (with moments that forget, what smooths a Gaussian
# must come more often than once in 64 steps), and earlier densification, as far as the scan's size allows.
FAST = Settings(
    init='lingo',
    init_density='fdk',
    outside='auto',
    normalise=True,
    iterations=1400,
    decay_steps=0,
    lambda_ssim=1.5,
    lambda_tv=0.15,
    tv_stride=2,
    rate_centre=(1e-3, 5e-5),
    rate_density=(5e-2, 3e-3),
    rate_scale=(1.5e-1, 5e-3),
    rate_rotation=(2e-2, 1e-3),
    beta1=0.8,
    beta2=0.95,
    average=0.97,
    densify_from=150,
    densify_until=800,
    densify_every=50,
    densify_threshold=1e-4,
    birth='halve',
    values_per_gaussian=14,
)

# Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", ACM TOG 42 (2023), and its released settings, on
# grey images. Its loss 0.8 L1 + 0.2 (1 - SSIM) is 0.8 times the one here, so that a gradient of 2e-4 there is 2.5e-4 here. Its
# scales have no bounds: these keep them where float32 and the footprints are sound.
GS3D = Settings(
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
# Cai et al., "Radiative Gaussian Splatting for Efficient X-ray Novel View Synthesis", ECCV 2024: radiance that is the same in
# all directions, the cuboid to start from, and the released settings of its foot scan. Its threshold is 2.7e-5 of that loss.
XGAUSSIAN = replace(
    GS3D,
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

METHODS = {'fast': FAST, 'lingo': LINGO, 'r2': R2, '3dgs': GS3D, 'xgaussian': XGAUSSIAN}
VOLUMETRIC = tuple(
    name for name, settings in METHODS.items() if settings.render == 'integral'
)  # those that make a volume


def settings_of(method: str, **values) -> Settings:
    """The settings of `name` or `name:setting=value,...`; `values` replace the recipe's own, but not those.

    Raises InputError for an unknown method or setting.
    """
    name, _, changes = method.partition(':')
    if name not in METHODS:
        raise InputError(f'{method}: the method is unknown; use one of {", ".join(METHODS)}')
    return METHODS[name].changed(**values).changed(**dict(c.partition('=')[::2] for c in changes.split(',') if c))
