"""The settings of a fit: every number with its name and source.

Code uses the parts. Users, command lines and files use flat names, which are unique across the parts:
`settings.changed(lambda_tv=0.1)`, `settings.flat()['lambda_tv']`, `-D lambda_tv=0.1`, `settings.loss.lambda_tv`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar

from lingo_mi.calibration.response.part import VARIES
from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.parsing import checked, nearest, parse, require_ranges
from lingo_mi.fitting.field.settings import FieldSettings
from lingo_mi.fitting.view_order import ORDERS
from lingo_mi.lingo.initialise import LingoSettings
from lingo_mi.projectors import cutoff

# By the setting `render`:
INITS = {'integral': ('edges', 'lingo', 'r2'), 'alpha': ('random', 'cuboid'), 'field': ('network',)}
# Ranges end where float32 or the time of a fit does, far beyond what is of use.
HELD_OUT = 5  # one view in so many, of the search for the step to stop at
MOST_STEPS, RATES, SCALES = 1e9, (1e-12, 1e3), (1e-9, 1e3)


@dataclass(frozen=True)
class StartSettings(LingoSettings):
    """The start of a fit: `LingoSettings` (all starts use its `n_points`), and

    init               'lingo' (paper, section III-A and B), 'r2' (an FDK volume), or 'edges' (own; a volume of SART, see
                       `lingo_mi.fitting.edge_start`); for alpha compositing 'random' (points in the volume; 3DGS without given
                       points) or 'cuboid' (X-Gaussian's regular grid); for a neural field 'network' (random parameters)
    cuboid_step        for `cuboid`: voxels between points (X-Gaussian: 8)
    fdk_threshold, fdk_rescale
                       for `r2`: see `lingo_mi.fitting.r2_start` (R2: 0.05 and 0.15)

    init_density='fdk' becomes 'lsq' if FDK cannot reconstruct the scan (source off the circle, panel that moves relative to
    the source, invalid pixels).
    """

    RANGES: ClassVar = LingoSettings.RANGES | dict(
        cuboid_step=(1, 1e6), fdk_threshold=(-1e6, 1e6), fdk_rescale=(0, 1e6)
    )

    init: str = 'r2'
    cuboid_step: int = 8
    fdk_threshold: float = 0.05
    fdk_rescale: float = 0.15

    def __post_init__(self):
        super().__post_init__()
        known = [name for names in INITS.values() for name in names]
        _require(self.init in known, f'init is one of {", ".join(known)}, not {shown(self.init)}')


@dataclass(frozen=True)
class ModelSettings:
    """The forward model.

    render             'integral': pixels are line integrals; 'alpha': grey images (projections divided by their maximum),
                       composited front to back from opacities and radiances (3DGS, see `lingo_mi.projectors.alpha`),
                       without a volume; 'field': line integrals of a neural attenuation field, by samples on the rays (NAF,
                       see `lingo_mi.fitting.field`)
    normalise          whether to fit densities in a unit that makes the largest line integral 1 (own). SSIM's constants
                       and the bounds then mean the same for any object. R2 expects volumes in [0, 1]. Of a neural field,
                       whose densities are below 1, the unit is a bound of the densities (see
                       `lingo_mi.fitting.field.densities`); NAF expects volumes in [0, 1], too
    sh_degree          for `alpha`: degree of the radiance's spherical harmonics, at most 3 (3DGS: 3); 0: the same radiance in
                       all directions (X-Gaussian)
    sh_every           for `alpha`: iterations between the starts of successive degrees (3DGS: 1000)
    extent             cut-off in standard deviations (R2: 3, rounded up to whole tiles of 16 x 16 pixels)
    effects            'model': the fit models the effects that the scene declares (spectrum, focal spot, blur, dead pixels);
                       'ignore': it treats all projections as line integrals
    """

    render: str = 'integral'
    normalise: bool = False
    sh_degree: int = 3
    sh_every: int = 1000
    extent: float = cutoff.FIT
    effects: str = 'model'

    def __post_init__(self):
        require_ranges(self, sh_degree=(0, 3), sh_every=(1, MOST_STEPS), extent=(1, 20))
        _require(self.render in INITS, f"render is 'integral', 'alpha' or 'field', not {self.render!r}")
        _require(self.effects in ('model', 'ignore'), f"effects is 'model' or 'ignore', not {self.effects!r}")


@dataclass(frozen=True)
class LossSettings:
    """The loss (paper, section III-C). That of a neural field is the mean squared error of its rays (NAF).

    lambda_l1          weight of the mean absolute error (1)
    lambda_ssim        weight of 1 - SSIM (0.25)
    lambda_gradient    weight of the root mean square of the error's gradient (own; see `losses.gradient_error`)
    lambda_tv          weight of the total variation of a random cube (0.05)
    tv_size            samples along its sides (32)
    tv_stride          voxels between samples (published: 1; own: 2 smooths eight times the volume at the same cost)
    tv_views           views up to which `lambda_tv` holds (own): with n views, if these are more, it is lambda_tv tv_views / n,
                       so that more data have no more total variation beside them; 0: it holds for any number
    weights            'equal'; or 'noise' (own): rendered and measured pixels are divided by the standard deviation of their
                       noise (from the scan's `ct_detector`) before comparison
    loss_scale         'none'; 'dynamic': the paper's factor T_g + 1 / (4 T_g) on the whole loss; 'statistic': the same
                       factor on the densification statistic only (Adam cancels a constant factor of the loss)
    """

    lambda_l1: float = 1.0
    lambda_ssim: float = 0.25
    lambda_gradient: float = 0.0
    lambda_tv: float = 0.05
    tv_size: int = 32
    tv_stride: int = 1
    tv_views: int = 0
    weights: str = 'equal'
    loss_scale: str = 'none'

    def __post_init__(self):
        weights = dict.fromkeys(('lambda_l1', 'lambda_ssim', 'lambda_gradient', 'lambda_tv'), (0, 1e6))
        require_ranges(self, **weights, tv_size=(1, 1e6), tv_stride=(1, 1e6), tv_views=(0, 1e6))
        _require(
            self.lambda_l1 + self.lambda_ssim + self.lambda_gradient > 0,
            'one of lambda_l1, lambda_ssim and lambda_gradient must be above 0: nothing else compares with the projections',
        )
        _require(self.weights in ('equal', 'noise'), f"weights is 'equal' or 'noise', not {self.weights!r}")
        _require(
            self.loss_scale in ('none', 'dynamic', 'statistic'),
            f"loss_scale is 'none', 'dynamic' or 'statistic', not {self.loss_scale!r}",
        )


@dataclass(frozen=True)
class AdamSettings:
    """Adam's step sizes (first, last) and moments. Step sizes fall log-linearly. Lengths are in the normalised frame.

    rate_centre, rate_density, rate_scale, rate_rotation
                       (R2: the defaults); for `alpha`, `rate_centre` is in units of the scene's radius (see `models.alpha`)
    rate_opacity, rate_radiance, rate_harmonics
                       for `alpha`, instead of `rate_density` (3DGS: 0.05, 0.0025 and a twentieth of that, all constant)
    rate_features, rate_network
                       of a neural field, instead of all the others (NAF: 0.001, later 0.0001)
    rate_pose          for corrections of the views' poses (own): radians, and units of half the volume's longest side;
                       0, 0: no corrections (see `lingo_mi.fitting.poses`)
    beta1, beta2       decay of the moments (R2: Adam's usual 0.9 and 0.999)
    nesterov           whether a step goes where the first moment will point after the next one (own; Dozat, "Incorporating
                       Nesterov momentum into Adam", 2016)
    epsilon            added to the root of the second moment (R2: 1e-15)
    average            decay of the running mean of the parameters, which is the result (own); 0: parameters of the last step
    """

    rate_centre: tuple[float, float] = (2e-4, 2e-5)
    rate_density: tuple[float, float] = (1e-2, 1e-3)
    rate_scale: tuple[float, float] = (5e-3, 5e-4)
    rate_rotation: tuple[float, float] = (1e-3, 1e-4)
    rate_opacity: tuple[float, float] = (5e-2, 5e-2)
    rate_radiance: tuple[float, float] = (2.5e-3, 2.5e-3)
    rate_harmonics: tuple[float, float] = (1.25e-4, 1.25e-4)
    rate_features: tuple[float, float] = (1e-3, 1e-4)
    rate_network: tuple[float, float] = (1e-3, 1e-4)
    rate_pose: tuple[float, float] = (0.0, 0.0)
    beta1: float = 0.9
    beta2: float = 0.999
    nesterov: bool = False
    epsilon: float = 1e-15
    average: float = 0.0

    def __post_init__(self):
        rates = {f.name: RATES for f in fields(self) if f.name.startswith('rate_')} | dict(rate_pose=(0, 1))
        for name in rates:
            if isinstance(given := getattr(self, name), list):
                object.__setattr__(self, name, tuple(given))
        decay = (0, 1 - 1e-6)  # beyond, float32 counts it as 1
        require_ranges(self, **rates, beta1=decay, beta2=decay, epsilon=(1e-30, 1), average=decay)
        _require(
            min(self.rate_pose) > 0 or self.rate_pose == (0, 0),
            f'rate_pose must be two positive numbers, first and last, or 0, not {self.rate_pose}',
        )

    def rate(self, name: str, share: float) -> float:
        """Step size of a parameter (see `lingo_mi.fitting.models`) or of 'pose'. share: progress of the decay, in [0, 1]."""
        first, last = getattr(self, f'rate_{name}')
        return first ** (1 - share) * last**share


@dataclass(frozen=True)
class CalibrationSettings:
    """Errors of the measurement that are found together with the cloud (own), each off unless asked for.

    fit_air            air level of the views (see `lingo_mi.calibration.response.air`): 'off'; 'smooth', a cubic polynomial in
                       time; or 'view', every view for itself
    fit_gain           gain of the views, likewise
    pose_motion        of the corrections that `rate_pose` asks for: 'view', every view for itself; or 'smooth', cubic
                       polynomials in time, which views that are held out get, too

    Time is told by the angles of the views, which must be in the order in which they were taken. A curve and scattered light,
    which a cloud would explain away, are found before a fit: `lm.calibrate`.
    """

    fit_air: str = 'off'
    fit_gain: str = 'off'
    pose_motion: str = 'view'

    def __post_init__(self):
        for name in ('fit_air', 'fit_gain'):
            value = getattr(self, name)
            _require(value in VARIES, f'{name} is one of {", ".join(VARIES)}, not {shown(value)}')
        _require(
            self.pose_motion in ('view', 'smooth'), f"pose_motion is 'view' or 'smooth', not {shown(self.pose_motion)}"
        )

    @property
    def responds(self) -> bool:
        """Whether a response of the detector is fitted."""
        return self.fit_air != 'off' or self.fit_gain != 'off'


@dataclass(frozen=True)
class StoppingSettings:
    """When a fit stops (own; see `lingo_mi.fitting.stopping`).

    stop               'off': after `iterations`; 'on': at the step from which a first fit, the search, predicts views that it
                       does not see no better; 'auto': 'on' where the scan says how many photons a pixel counts, else 'off'
    stop_every         iterations between two looks at these views
    stop_patience      iterations without a better prediction, after which the search ends, at least `stop_every`
    """

    stop: str = 'off'
    stop_every: int = 50
    stop_patience: int = 150

    def __post_init__(self):
        _require(self.stop in ('off', 'on', 'auto'), f"stop is 'off', 'on' or 'auto', not {shown(self.stop)}")
        require_ranges(self, stop_every=(1, MOST_STEPS), stop_patience=(1, MOST_STEPS))
        _require(
            self.stop_patience >= self.stop_every,
            f'stop_patience must be at least stop_every, {self.stop_every}, not {self.stop_patience}',
        )


@dataclass(frozen=True)
class DensificationSettings:
    """Adaptive density control (see `lingo_mi.fitting.densify`). Lengths are in the normalised frame; for `alpha`, `split_size`
    and `prune_size` are in units of the scene's radius.

    densify_from, densify_until, densify_every   iterations (500, 15000, 100)
    densify_threshold  mean gradient of the projected centre, in normalised device units (5e-5)
    birth              'clone': small Gaussians are cloned, large ones split (R2); 'halve': all are cut in two along their
                       longest axis, which keeps mass and covariance (own)
    split_size         for 'clone': Gaussians with a larger standard deviation are split (R2: 0.1 of the longest side)
    prune_density      Gaussians of lower density are removed, and those outside the volume (1e-5); for `alpha` it is an
                       opacity, and Gaussians outside stay (3DGS: 0.005)
    reset_every        for `alpha`: iterations between resets of the opacities to 0.01, during densification (3DGS: 3000);
                       0: never
    prune_size         for `alpha`: Gaussians with a larger standard deviation are removed after the first reset (3DGS: 0.1)
    max_gaussians      largest number of Gaussians that densification makes (500k)
    values_per_gaussian
                       least number of measured values for each Gaussian (own; 0: no limit). Limits the Gaussians at the
                       start and later, since a small scan cannot determine many
    """

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

    def __post_init__(self):
        steps, sizes = (0, MOST_STEPS), (0, 1e6)
        require_ranges(
            self,
            densify_from=steps,
            densify_until=steps,
            densify_every=(1, MOST_STEPS),
            densify_threshold=sizes,
            split_size=sizes,
            prune_density=sizes,
            reset_every=steps,
            prune_size=sizes,
            max_gaussians=(1, 1e9),
            values_per_gaussian=(0, 1e9),
        )
        _require(self.birth in ('clone', 'halve'), f"birth is 'clone' or 'halve', not {self.birth!r}")


@dataclass(frozen=True)
class ScaleBounds:
    """Bounds of standard deviations, in the normalised frame (R2: 5e-4 and 0.5 of the longest side)."""

    scale_min: float = 1e-3
    scale_max: float = 1.0

    def __post_init__(self):
        require_ranges(self, scale_min=SCALES, scale_max=SCALES)
        _require(self.scale_min < self.scale_max, 'scale_min must be below scale_max')


@dataclass(frozen=True)
class Settings:
    """All settings of a fit. In the normalised frame the volume's longest side is 2. Defaults are R2-Gaussian's published values.

    iterations         Adam steps
    decay_steps        iterations over which the rates fall from first to last; 0: `iterations`
    batch              views per step
    view_order         'random'; or 'golden': any few views in a row lie well apart (own; see `lingo_mi.fitting.view_order`)
    coarse_share       share of the iterations, at the start, that use views binned 2 x 2 (own): a quarter of the pixels
    checkpoint_seconds time between checkpoints
    start, model, neural, loss, adam, calibration, stopping, densification, bounds
                       the parts, each with its own documentation

    Raises InputError for a value out of its range, and for contradictory values.
    """

    iterations: int = 30_000
    decay_steps: int = 30_000
    batch: int = 1
    view_order: str = 'random'
    coarse_share: float = 0.0
    checkpoint_seconds: float = 30.0
    start: StartSettings = field(default_factory=StartSettings)
    model: ModelSettings = field(default_factory=ModelSettings)
    neural: FieldSettings = field(default_factory=FieldSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    adam: AdamSettings = field(default_factory=AdamSettings)
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    stopping: StoppingSettings = field(default_factory=StoppingSettings)
    densification: DensificationSettings = field(default_factory=DensificationSettings)
    bounds: ScaleBounds = field(default_factory=ScaleBounds)

    def __post_init__(self):
        require_ranges(
            self,
            iterations=(1, MOST_STEPS),
            decay_steps=(0, MOST_STEPS),
            batch=(1, 1e6),
            coarse_share=(0, 1),
            checkpoint_seconds=(0, 1e9),
        )
        _require(self.view_order in ORDERS, f'view_order is one of {", ".join(ORDERS)}, not {shown(self.view_order)}')
        inits, init = INITS[self.model.render], self.start.init
        _require(
            init in inits, f'init is {" or ".join(map(repr, inits))} with render={self.model.render}, not {init!r}'
        )
        _require(
            self.model.render != 'alpha'
            or self.model.normalise
            and self.loss.lambda_tv == 0
            and self.model.effects == 'ignore',
            'render=alpha composites grey images and knows no densities: it needs normalise=true, lambda_tv=0 and '
            'effects=ignore, as in the method 3dgs',
        )
        _require(
            self.volumetric or not self.calibration.responds,
            'render=alpha composites grey images, which have no air level: leave fit_air and fit_gain off',
        )
        _require(
            self.model.render != 'field'
            or self.loss == LossSettings(lambda_ssim=0.0, lambda_tv=0.0, tv_size=self.loss.tv_size)
            and self.model.effects == 'ignore'
            and self.coarse_share == 0
            and self.adam.rate_pose == (0, 0)
            and not self.calibration.responds,
            'render=field fits line integrals on single rays: it needs lambda_ssim=0, lambda_tv=0, effects=ignore, equal '
            'weights and no loss_scale, coarse_share, rate_pose, fit_air or fit_gain, as in the method naf',
        )
        _require(
            not (self.volumetric and self.densification.reset_every),
            'reset_every lowers opacities, which only render=alpha has: leave it out',
        )

    @property
    def volumetric(self) -> bool:
        """Whether a fit finds densities and so a volume. Only alpha compositing does not."""
        return self.model.render != 'alpha'

    @property
    def cloud(self) -> bool:
        """Whether a fit is one of Gaussians. Only that of a neural field is not."""
        return self.model.render != 'field'

    def rate(self, name: str, iteration: int) -> float:
        """Adam's step size for a parameter (see `lingo_mi.fitting.models`) or 'pose' at an iteration, counted from 0."""
        return self.adam.rate(name, min(iteration / max(self.decay_steps or self.iterations, 1), 1.0))

    def flat(self) -> dict:
        """All values by their flat names, as in files and on command lines."""
        return {name: value for _, values in self._parts() for name, value in values.items()}

    def changed(self, /, **values: Any) -> Settings:
        """A copy with new values, by flat name. Values may be strings, as from a command line.

        Raises InputError for an unknown name or a value of the wrong kind.

        Example: `R2.changed(iterations=800, lambda_tv=0.1)`.
        """
        known = Settings().flat()  # of the kinds to expect
        for name, value in values.items():
            if name not in known:
                raise InputError(
                    f'unknown setting {name!r}{nearest(name, known) or ": see the documentation of Settings"}'
                )
            of_kind = parse if isinstance(value, str) else checked
            values[name] = of_kind(f'setting {name}', value, known[name])
        changes = {}
        for part, own in self._parts():
            new = {name: values[name] for name in own if name in values}
            if part and new:
                changes[part] = replace(getattr(self, part), **new)
            else:
                changes |= new
        return replace(self, **changes)

    def _parts(self):
        """Pairs (name of a part, its flat values). The first pair, with the name '', has the values that are in no part."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        yield '', {name: value for name, value in own.items() if not is_dataclass(value)}
        for name, part in own.items():
            if is_dataclass(part):
                yield name, {f.name: getattr(part, f.name) for f in fields(part)}


def _require(good: bool, message: str):
    if not good:
        raise InputError(message)
