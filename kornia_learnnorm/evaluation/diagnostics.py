r"""Diagnostics of a normalisation: its effect on the design matrix, the rank-2 projection and the points."""

from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm import symmetric_epipolar_distance
from kornia_learnnorm.geometry import checks, dlt, matrices, transforms
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.normalizers.normalizer import Normalizer, normalizing_transforms


class Diagnostics(NamedTuple):
    """One number per sample, (B,) each."""

    # First over eighth singular value of the design matrix (the ninth is the residual), infinite for lower rank.
    condition_number: Tensor
    singularity_ratio: Tensor  # second over third singular value of the DLT's matrix, before the projection to rank 2
    distance1: Tensor  # mean normalised distance from the origin in the first view; Hartley's is the root of two
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
    checks.check_correspondences(points1, points2)
    problem = LinearProblem.from_points(points1, points2, None, Fundamental())
    return diagnose_in_coordinates(problem, *normalizing_transforms(normalizer, problem))


def diagnose_in_coordinates(problem: LinearProblem, T1: Tensor, T2: Tensor) -> Diagnostics:
    """Return the diagnostics of a problem under known transforms (B, 3, 3); see :func:`diagnose`."""
    points1, points2 = problem.points1, problem.points2
    x1, x2 = convert_points_to_homogeneous(points1) @ T1.mT, convert_points_to_homogeneous(points2) @ T2.mT
    F_hat = problem.solve_in(T1, T2)[0]
    both = (transforms.transform_fundamental(F_mat, T1, T2) for F_mat in (F_hat, matrices.nearest_rank2(F_hat)))
    before, after = (symmetric_epipolar_distance(points1, points2, F_mat).mean(-1) for F_mat in both)
    d, r = torch.linalg.svdvals(dlt.design_matrix(x1, x2)), torch.linalg.svdvals(F_hat)
    distance1, distance2 = (x[..., :2].norm(dim=-1).mean(-1) for x in (x1, x2))
    return Diagnostics(d[..., 0] / d[..., 7], r[..., 1] / r[..., 2], distance1, distance2, 1 - before / after)
