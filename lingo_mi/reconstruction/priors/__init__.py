"""Priors for `PenalisedLeastSquares`: knowledge of a volume besides its projections."""

from lingo_mi.reconstruction.priors.denoiser import Denoiser, NonLocalMeans
from lingo_mi.reconstruction.priors.generalised_variation import TGV
from lingo_mi.reconstruction.priors.huber import Huber
from lingo_mi.reconstruction.priors.prior import Prior
from lingo_mi.reconstruction.priors.prior_sum import PriorSum
from lingo_mi.reconstruction.priors.total_variation import TV, DirectionalTV
from lingo_mi.reconstruction.priors.wavelets import Wavelets

__all__ = ['TGV', 'TV', 'Denoiser', 'DirectionalTV', 'Huber', 'NonLocalMeans', 'Prior', 'PriorSum', 'Wavelets']
