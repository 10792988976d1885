"""Options of the loss: the comparison in a step, and its weights (paper, section III-C)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

from lingo_mi.fitting import losses
from lingo_mi.fitting.options.part import Part, require

WEIGHT = (0, 1e6)


@dataclass(frozen=True)
class ImageLoss(Part):
    """The loss of a rendered image beside the measured one.

    Parameters
    ----------
    lambda_l1 : float
        Weight of the mean absolute error (R2-Gaussian: 1).
    lambda_ssim : float
        Weight of 1 - SSIM (R2-Gaussian: 0.25).
    lambda_gradient : float
        Weight of the root mean square of the error's gradient, which R2-Gaussian does not have; see `losses.gradient_error`.
    weights : {'equal', 'noise'}
        'noise' divides rendered and measured pixels by the standard deviation of their noise, which follows from the scan's
        `ct_detector`.

    Examples
    --------
    `lm.GaussianSplatting(loss=lm.ImageLoss(lambda_ssim=0))`
    """

    RANGES: ClassVar = dict.fromkeys(('lambda_l1', 'lambda_ssim', 'lambda_gradient'), WEIGHT)
    CHOICES: ClassVar = dict(weights=('equal', 'noise'))

    lambda_l1: float = 1.0
    lambda_ssim: float = 0.25
    lambda_gradient: float = 0.0
    weights: str = 'equal'

    loss_scale: ClassVar[str] = 'none'

    def __post_init__(self):
        super().__post_init__()
        require(
            self.lambda_l1 + self.lambda_ssim + self.lambda_gradient > 0,
            'one of lambda_l1, lambda_ssim and lambda_gradient must be above 0: nothing else compares with the projections',
        )

    def value(self, image: Any, measured: Any, height: int, width: int) -> Any:
        """Compute the loss of an image. Differentiable.

        Parameters
        ----------
        image, measured : Float [height * width]
            Rendered and measured pixels, row by row.
        height, width : int
            Size of the image.

        Returns
        -------
        Float [1]
            The loss.
        """
        return losses.combined(image, measured, height, width, self.lambda_ssim, self.lambda_gradient, self.lambda_l1)


@dataclass(frozen=True)
class Loss(ImageLoss):
    """The loss of an image and of the volume that the Gaussians make.

    Parameters
    ----------
    lambda_l1, lambda_ssim, lambda_gradient, weights
        See `ImageLoss`.
    lambda_tv : float
        Weight of the total variation of a random cube (R2-Gaussian: 0.05).
    tv_size : int
        Samples along the sides of the cube (R2-Gaussian: 32).
    tv_stride : int
        Voxels between samples (R2-Gaussian: 1). 2 smooths eight times the volume at the same cost.
    tv_views : int
        Number of views up to which `lambda_tv` holds. The weight for n views, if these are more, is lambda_tv tv_views / n,
        because more data need less total variation. 0: `lambda_tv` holds for any number.
    loss_scale : {'none', 'dynamic', 'statistic'}
        'dynamic': LINGO's factor T_g + 1 / (4 T_g) on the whole loss. 'statistic': the same factor on the densification
        statistic alone, since Adam cancels a constant factor of the loss.

    Examples
    --------
    `lm.R2(loss=lm.Loss(lambda_tv=0.1))`
    """

    RANGES: ClassVar = ImageLoss.RANGES | dict(
        lambda_tv=WEIGHT, tv_size=(1, 1e6), tv_stride=(1, 1e6), tv_views=(0, 1e6)
    )
    CHOICES: ClassVar = ImageLoss.CHOICES | dict(loss_scale=('none', 'dynamic', 'statistic'))

    lambda_tv: float = 0.05
    tv_size: int = 32
    tv_stride: int = 1
    tv_views: int = 0
    loss_scale: str = 'none'

    def limited(self, views: int) -> Loss:
        """Return the same loss for a scan of so many views: see `tv_views`.

        Parameters
        ----------
        views : int
            Views of the scan.

        Returns
        -------
        Loss
            With a smaller `lambda_tv` for more than `tv_views` views.
        """
        if not 0 < self.tv_views < views:
            return self
        return replace(self, lambda_tv=self.lambda_tv * self.tv_views / views, tv_views=0)
