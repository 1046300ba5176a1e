r"""Learned normalisation for the normalised eight-point algorithm, composed with Kornia.

Example:
    >>> import torch, kornia_learnnorm as kln
    >>> points1, points2 = torch.rand(4, 8, 2) * 600, torch.rand(4, 8, 2) * 600
    >>> F_mat = kln.find_fundamental(points1, points2, normalizer=kln.LearnedNormalizer.from_pretrained())
    >>> F_mat.shape
    torch.Size([4, 3, 3])

"""

from kornia_learnnorm.estimators.learned import LearnedEightPoint, LearnedEstimate, StageEstimate
from kornia_learnnorm.estimators.linear import EightPoint, TwoViewEstimate, find_fundamental
from kornia_learnnorm.estimators.refinement import EssentialRefinement, Refinement, refine_essential, refine_fundamental
from kornia_learnnorm.estimators.robust_losses import Cauchy, GemanMcClure, Huber, Truncated, squared_loss
from kornia_learnnorm.evaluation.diagnostics import Diagnostics, diagnose
from kornia_learnnorm.evaluation.search import SearchedNormalizer
from kornia_learnnorm.geometry.distances import (
    algebraic_distance,
    sampson_distance,
    symmetric_epipolar_distance,
)
from kornia_learnnorm.geometry.dlt import design_matrix, null_vector
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.geometry.rank2 import optimal_rank2, rank2_projection
from kornia_learnnorm.geometry.transforms import paper_transform, spd_transform
from kornia_learnnorm.losses import BoundedEpipolarLoss, EpipolarLoss, InlierLoss, LogEpipolarLoss
from kornia_learnnorm.metrics.better_rate import BetterRate, better_rate
from kornia_learnnorm.metrics.bootstrap import PairedDifference, bootstrap_interval, paired_bootstrap
from kornia_learnnorm.metrics.inliers import epipolar_error, f1_score, inlier_share
from kornia_learnnorm.metrics.poses import mean_average_accuracy, pose_auc, pose_error
from kornia_learnnorm.normalizers.hartley import Hartley
from kornia_learnnorm.normalizers.identity import Identity
from kornia_learnnorm.normalizers.learned_normalizer import LearnedNormalizer
from kornia_learnnorm.normalizers.networks.crossview import CrossViewNetwork
from kornia_learnnorm.normalizers.networks.paper import PaperNetwork
from kornia_learnnorm.normalizers.normalizer import PerView
from kornia_learnnorm.normalizers.reweighted import ReweightedWhitening
from kornia_learnnorm.normalizers.whitening import Whitening
from kornia_learnnorm.ransac.ransac import RANSAC, RansacResult
from kornia_learnnorm.ransac.samplers import ProsacSampler, WeightedSampler
from kornia_learnnorm.ransac.soft import SoftChoice, expected_loss, sample_minimal_sets
from kornia_learnnorm.two_view.estimate_matches import estimate_matches
from kornia_learnnorm.two_view.estimate_pair import estimate_pair
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate
from kornia_learnnorm.two_view.warnings import PairWarning

__version__ = "0.1.0"

__all__ = [
    "RANSAC",
    "BetterRate",
    "BoundedEpipolarLoss",
    "Cauchy",
    "CrossViewNetwork",
    "Diagnostics",
    "EightPoint",
    "EpipolarLoss",
    "EssentialRefinement",
    "GemanMcClure",
    "Hartley",
    "Huber",
    "Identity",
    "InlierLoss",
    "LearnedEightPoint",
    "LearnedEstimate",
    "LearnedNormalizer",
    "LogEpipolarLoss",
    "NoReliableMatrixError",
    "PairEstimate",
    "PairWarning",
    "PairedDifference",
    "PaperNetwork",
    "PerView",
    "ProsacSampler",
    "RansacResult",
    "Refinement",
    "ReweightedWhitening",
    "SearchedNormalizer",
    "SoftChoice",
    "StageEstimate",
    "Truncated",
    "TwoViewEstimate",
    "WeightedSampler",
    "Whitening",
    "algebraic_distance",
    "better_rate",
    "bootstrap_interval",
    "design_matrix",
    "diagnose",
    "epipolar_error",
    "estimate_matches",
    "estimate_pair",
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
    "refine_essential",
    "refine_fundamental",
    "relative_pose",
    "sample_minimal_sets",
    "sampson_distance",
    "spd_transform",
    "squared_loss",
    "symmetric_epipolar_distance",
]
