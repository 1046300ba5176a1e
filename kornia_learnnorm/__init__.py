r"""Learned normalisation for the normalised eight-point algorithm, composed with Kornia.

Example:
    >>> import torch, kornia_learnnorm as kln
    >>> points1, points2 = torch.rand(4, 8, 2) * 600, torch.rand(4, 8, 2) * 600
    >>> F_mat = kln.find_fundamental(points1, points2, normalizer=kln.LearnedNormalizer.from_pretrained())
    >>> F_mat.shape
    torch.Size([4, 3, 3])

"""

from kornia_learnnorm.diagnostics import Diagnostics, diagnose
from kornia_learnnorm.estimators import EightPoint
from kornia_learnnorm.learned import LearnedNormalizer
from kornia_learnnorm.losses import EpipolarLoss
from kornia_learnnorm.metrics import BetterRate, better_rate, bootstrap_interval
from kornia_learnnorm.networks import CrossViewNetwork
from kornia_learnnorm.normalizers import Hartley, Identity, PerView, Whitening
from kornia_learnnorm.paper_network import PaperNetwork
from kornia_learnnorm.residuals import algebraic_distance, sampson_distance, symmetric_epipolar_distance
from kornia_learnnorm.reweighting import ReweightedWhitening
from kornia_learnnorm.search import SearchedNormalizer
from kornia_learnnorm.solver import design_matrix, find_fundamental, null_vector, rank2_projection
from kornia_learnnorm.transforms import paper_transform, spd_transform

__version__ = "0.1.0"

__all__ = [
    "BetterRate",
    "CrossViewNetwork",
    "Diagnostics",
    "EightPoint",
    "EpipolarLoss",
    "Hartley",
    "Identity",
    "LearnedNormalizer",
    "PaperNetwork",
    "PerView",
    "ReweightedWhitening",
    "SearchedNormalizer",
    "Whitening",
    "algebraic_distance",
    "better_rate",
    "bootstrap_interval",
    "design_matrix",
    "diagnose",
    "find_fundamental",
    "null_vector",
    "paper_transform",
    "rank2_projection",
    "sampson_distance",
    "spd_transform",
    "symmetric_epipolar_distance",
]
