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
from kornia_learnnorm.linear import design_matrix, null_vector, rank2_projection
from kornia_learnnorm.losses import EpipolarLoss
from kornia_learnnorm.metrics import BetterRate, better_rate, bootstrap_interval
from kornia_learnnorm.networks import CrossViewNetwork
from kornia_learnnorm.normalizers import Hartley, Identity, PerView, Whitening
from kornia_learnnorm.objectives import Cauchy, GemanMcClure, Huber, Truncated
from kornia_learnnorm.optimal_rank2 import optimal_rank2
from kornia_learnnorm.pair_metrics import epipolar_error, f1_score, inlier_share, paired_bootstrap
from kornia_learnnorm.paper_network import PaperNetwork
from kornia_learnnorm.pose_accuracy import mean_average_accuracy, pose_auc
from kornia_learnnorm.pose_metrics import pose_error, relative_pose
from kornia_learnnorm.ransac import RANSAC
from kornia_learnnorm.refine import refine_fundamental
from kornia_learnnorm.residuals import algebraic_distance, sampson_distance, symmetric_epipolar_distance
from kornia_learnnorm.reweighting import ReweightedWhitening
from kornia_learnnorm.sampling import ProsacSampler, WeightedSampler
from kornia_learnnorm.search import SearchedNormalizer
from kornia_learnnorm.soft import expected_loss, sample_minimal_sets
from kornia_learnnorm.solver import find_fundamental
from kornia_learnnorm.transforms import paper_transform, spd_transform

__version__ = "0.1.0"

__all__ = [
    "RANSAC",
    "BetterRate",
    "Cauchy",
    "CrossViewNetwork",
    "Diagnostics",
    "EightPoint",
    "EpipolarLoss",
    "GemanMcClure",
    "Hartley",
    "Huber",
    "Identity",
    "LearnedNormalizer",
    "PaperNetwork",
    "PerView",
    "ProsacSampler",
    "ReweightedWhitening",
    "SearchedNormalizer",
    "Truncated",
    "WeightedSampler",
    "Whitening",
    "algebraic_distance",
    "better_rate",
    "bootstrap_interval",
    "design_matrix",
    "diagnose",
    "epipolar_error",
    "expected_loss",
    "f1_score",
    "find_fundamental",
    "inlier_share",
    "mean_average_accuracy",
    "null_vector",
    "optimal_rank2",
    "paired_bootstrap",
    "paper_transform",
    "pose_auc",
    "pose_error",
    "rank2_projection",
    "refine_fundamental",
    "relative_pose",
    "sample_minimal_sets",
    "sampson_distance",
    "spd_transform",
    "symmetric_epipolar_distance",
]
