r"""F, E and H from matches with outliers in one differentiable pass, composed with Kornia.

Example:
    >>> import torch, kornia_learnnorm as kln
    >>> points1, points2 = torch.rand(4, 8, 2) * 600, torch.rand(4, 8, 2) * 600
    >>> F_mat = kln.find_fundamental(points1, points2, normalizer=kln.LearnedNormalizer.from_pretrained())
    >>> F_mat.shape
    torch.Size([4, 3, 3])
"""

from .estimators.learned_eight_point import LearnedEightPoint
from .estimators.learned_homography import LearnedHomography
from .estimators.learned_relative_pose import LearnedRelativePose
from .estimators.linear import EightPoint, find_fundamental, find_homography
from .estimators.match_refiner import MatchRefiner
from .estimators.refinement import refine_essential, refine_fundamental
from .estimators.robust_losses import Cauchy, GemanMcClure, Huber, Truncated
from .geometry.distances import algebraic_distance, sampson_distance, symmetric_epipolar_distance, transfer_distance
from .geometry.pose import relative_pose
from .geometry.rank2_correction import optimal_rank2
from .normalizers.closed_form import Hartley, Identity, Whitening
from .normalizers.learned_normalizer import LearnedNormalizer
from .normalizers.networks.crossview import CrossViewNetwork
from .normalizers.networks.paper import PaperNetwork
from .normalizers.normalizer import PerView
from .normalizers.reweighted import ReweightedWhitening
from .ransac.ransac import RANSAC
from .training_losses import BoundedEpipolarLoss, EpipolarLoss, InlierLoss, LogEpipolarLoss, LogEssentialLoss
from .two_view.estimate_matches import estimate_matches
from .two_view.estimate_pair import estimate_pair
from .two_view.result import NoReliableMatrixError

__version__ = "0.1.0"

__all__ = ["RANSAC", "EightPoint", "LearnedEightPoint", "LearnedHomography", "LearnedRelativePose", "MatchRefiner"]
__all__ += ["Hartley", "Identity", "LearnedNormalizer", "PerView", "ReweightedWhitening", "Whitening"]
__all__ += ["CrossViewNetwork", "PaperNetwork"]
__all__ += ["BoundedEpipolarLoss", "EpipolarLoss", "InlierLoss", "LogEpipolarLoss", "LogEssentialLoss"]
__all__ += ["Cauchy", "GemanMcClure", "Huber", "Truncated"]
__all__ += ["find_fundamental", "find_homography", "optimal_rank2", "refine_essential", "refine_fundamental"]
__all__ += ["algebraic_distance", "sampson_distance", "symmetric_epipolar_distance", "transfer_distance"]
__all__ += ["NoReliableMatrixError", "estimate_matches", "estimate_pair", "relative_pose"]
