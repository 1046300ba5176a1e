r"""Diagnostics of a normalisation: its effect on the design matrix, the rank-2 projection and the points."""

from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.geometry.checks import check_correspondences
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.dlt import design_matrix
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.rank2 import rank2_projection
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.normalizers.normalizer import Normalizer, normalizing_transforms

__all__ = ["Diagnostics", "condition_number", "diagnose", "normalized_distance", "singularity_ratio"]


class Diagnostics(NamedTuple):
    """One number per sample, (B,) each."""

    condition_number: Tensor  # of the design matrix
    singularity_ratio: Tensor  # of the DLT's matrix before the projection to rank 2
    distance1: Tensor  # mean normalised distance from the origin in the first view
    distance2: Tensor  # the same in the second view
    # Share of the mean symmetric epipolar distance that the projection adds, 1 - e_DLT / e: one with eight points,
    # where the DLT has no error; negative where the projection lowers the distance; meaningless where both distances
    # are rounding errors.
    rank2_share: Tensor


def diagnose(points1: Tensor, points2: Tensor, normalizer: Normalizer) -> Diagnostics:
    r"""Compute the diagnostics of a normaliser on samples, pixels :math:`(B, N, 2)` with :math:`N \ge 8`, float64.

    They are those of Fan et al., sections 3 and 4.

    Example:
        >>> from kornia_learnnorm import Hartley
        >>> _ = torch.manual_seed(0)
        >>> diagnose(torch.rand(2, 8, 2), torch.rand(2, 8, 2), Hartley()).distance1
        tensor([1.4142, 1.4142], dtype=torch.float64)
    """
    check_correspondences(points1, points2)
    problem = LinearProblem.from_points(points1, points2, None, Fundamental())
    return diagnose_in_coordinates(problem, *normalizing_transforms(normalizer, problem))


def diagnose_in_coordinates(problem: LinearProblem, T1: Tensor, T2: Tensor) -> Diagnostics:
    """Return the diagnostics of a problem under known transforms (B, 3, 3); see :func:`diagnose`."""
    points1, points2 = problem.points1, problem.points2
    x1, x2 = convert_points_to_homogeneous(points1) @ T1.mT, convert_points_to_homogeneous(points2) @ T2.mT
    A, F_hat = design_matrix(x1, x2), problem.solve_in(T1, T2)[0]
    matrices = (transform_fundamental(F_mat, T1, T2) for F_mat in (F_hat, rank2_projection(F_hat)))
    before, after = (symmetric_epipolar_distance(points1, points2, F_mat).mean(-1) for F_mat in matrices)
    return Diagnostics(
        condition_number(A),
        singularity_ratio(F_hat),
        normalized_distance(points1, T1),
        normalized_distance(points2, T2),
        1 - before / after,
    )


def condition_number(A: Tensor) -> Tensor:
    r"""Return :math:`\kappa(A) = \sqrt{d_1 / d_8}` with the descending eigenvalues :math:`d_i` of :math:`A^\top A`.

    The ninth eigenvalue of design matrices :math:`(*, N, 9)` is left out: it is zero, or the residual (Fan et al.,
    section 3). Up to rounding, a matrix of lower rank gives infinity and a zero matrix NaN.
    """
    KORNIA_CHECK_SHAPE(A, ["*", "N", "9"])
    if A.shape[-2] < 8:
        raise ValueError(f"a design matrix has at least eight rows, got shape {[*A.shape]}")
    s: Tensor = torch.linalg.svdvals(A)
    return s[..., 0] / s[..., 7]


def singularity_ratio(F_mat: Tensor) -> Tensor:
    r"""Return :math:`\rho = r_2 / r_3`, the two smaller singular values of matrices :math:`(*, 3, 3)` before rank 2.

    The larger the ratio, the less the projection to rank 2 changes the matrix (Fan et al., section 4).
    """
    KORNIA_CHECK_SHAPE(F_mat, ["*", "3", "3"])
    s: Tensor = torch.linalg.svdvals(F_mat)
    return s[..., 1] / s[..., 2]


def normalized_distance(points: Tensor, T: Tensor) -> Tensor:
    r"""Return the mean distance of the points under T from the origin, without unit; Hartley's is :math:`\sqrt 2`."""
    KORNIA_CHECK_SHAPE(points, ["*", "N", "2"])
    KORNIA_CHECK_SHAPE(T, ["*", "3", "3"])
    x = convert_points_to_homogeneous(points) @ T.mT
    distances: Tensor = torch.linalg.vector_norm(x[..., :2], dim=-1)
    return distances.mean(-1)
