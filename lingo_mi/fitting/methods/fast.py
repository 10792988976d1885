"""The default method: LINGO's masks and loss scale in a fit of 600 steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lingo_mi.fitting.methods.densities import DensityMethod
from lingo_mi.fitting.options.densification import Densify, Halve
from lingo_mi.fitting.options.loss import Loss
from lingo_mi.fitting.options.rates import DensityRates
from lingo_mi.fitting.options.stopping import Stopping
from lingo_mi.fitting.start.edges import EdgeStart
from lingo_mi.fitting.start.start import Start


@dataclass(frozen=True)
class Fast(DensityMethod):
    """The default: LINGO's masks and loss scale in a fit of 600 steps, tuned on the foot and chest phantoms and the engine.

    As in `LINGO`, Otsu masks of all views decide where Gaussians start, and the dynamic scale multiplies the loss. The fit
    differs from the published one in these points:

    - Within the masks, Gaussians start on the edges of a quick reconstruction, and their densities are the densities of its
      voxels.
    - Besides L1, the loss has the gradient of the difference, which restores fine detail sooner, and more weight on SSIM.
    - Rates are 3 to 40 times those of `LINGO`, and fall over the run. Adam's second moment has a shorter memory, its first one is
      Nesterov's, and the result is the mean of the last steps.
    - Successive views lie well apart.
    - The total variation covers eight times the volume, since with a short memory each Gaussian must be smoothed more often than
      once in 64 steps. With more views it weighs less.
    - Densification starts early, and the scan's size limits it. The loss scale, about 2 with `normalise`, multiplies the
      gradients, so the threshold is higher.
    - The fit stops early if the scan says how many photons a pixel counts.

    It has the options of `DensityMethod`.

    Examples
    --------
    >>> Fast(iterations=300).densify.name
    'halve'
    """

    name: ClassVar = 'fast'

    iterations: int = 600
    view_order: str = 'golden'
    stopping: Stopping = Stopping(stop='auto')
    rates: DensityRates = DensityRates(
        decay_steps=0,
        beta1=0.96,
        beta2=0.97,
        nesterov=True,
        average=0.97,
        rate_centre=(2e-3, 7e-5),
        rate_density=(2e-1, 6e-3),
        rate_scale=(2e-1, 5e-3),
        rate_rotation=(2e-2, 1e-3),
    )
    start: Start = EdgeStart()
    loss: Loss = Loss(
        lambda_ssim=1.0, lambda_gradient=3.0, lambda_tv=0.4, tv_stride=2, tv_views=25, loss_scale='dynamic'
    )
    densify: Densify = Halve(
        densify_from=50, densify_until=300, densify_every=25, densify_threshold=2e-4, values_per_gaussian=14.0
    )
    normalise: bool = True
