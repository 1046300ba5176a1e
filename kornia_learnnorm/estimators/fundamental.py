r"""The linear solver for the fundamental matrix.

A pair of point sets goes from pixels to a fundamental matrix in :func:`find_fundamental`: checked, normalised and
solved once as a :class:`~kornia_learnnorm.geometry.problem.LinearProblem`, then given rank 2 in the coordinates that a
normaliser chooses.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from kornia_learnnorm.geometry.checks import check_correspondences, check_rank2, needs_gradient
from kornia_learnnorm.geometry.dlt import independence_gap
from kornia_learnnorm.geometry.matrices import inverse
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.rank2 import correct_rank2, rank2_projection
from kornia_learnnorm.geometry.transforms import transform_fundamental, unit_fundamental
from kornia_learnnorm.normalizers.contract import Normalizer, normalizing_transforms
from kornia_learnnorm.normalizers.hartley import Hartley

__all__ = ["find_fundamental", "solve_fundamental", "solve_in_coordinates"]


def find_fundamental(
    points1: Tensor,
    points2: Tensor,
    weights: Tensor | None = None,
    normalizer: Normalizer | None = None,
    rank2: Literal["projection", "optimal"] = "projection",
) -> Tensor:
    r"""Compute the fundamental matrix from eight or more correspondences by the normalised eight-point algorithm.

    The points are mapped to normalised coordinates :math:`\hat x_i = T_i x_i`, the direct linear transformation (DLT)
    finds :math:`\hat F` with :math:`\hat x_2^\top \hat F \hat x_1 = 0`, the rank-2 constraint is enforced **there**,
    and :math:`F = T_2^\top \hat F T_1`. With eight points the DLT is exact, and the normalisation acts only through the
    metric in which :math:`F` is projected. With ``rank2="optimal"``, :math:`T_2^\top \hat F T_1` is corrected by
    :func:`~kornia_learnnorm.optimal_rank2` instead; eight points then need no normalisation, and the normaliser is not
    called.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        weights: optional non-negative weights :math:`(B, N)` of the squared algebraic residuals; zero means absent.
        normalizer: maps ``(points1, points2, weights)`` to the transforms :math:`(B, 3, 3)` of both views;
            :class:`~kornia_learnnorm.Hartley` when not given.
        rank2: how the singularity constraint is enforced: ``"projection"`` in Frobenius norm in normalised coordinates,
            or ``"optimal"`` correction with the covariance of :math:`F`.

    Returns:
        fundamental matrices with shape :math:`(B, 3, 3)` in the dtype of the points, of rank 2 and unit Frobenius norm,
        :math:`x_2^\top F x_1 = 0`, with the sign of :func:`~kornia_learnnorm.geometry.transforms.unit_fundamental`.
        Where the correspondences do not determine :math:`F` (coincident, collinear or coplanar points) it is one of the
        solutions and carries no gradient.

    Raises:
        TypeError: if the points are not floating-point tensors of one dtype, or the normaliser cannot be called.
        ShapeError: if the shapes do not agree with the above.
        ValueError: if there are fewer than eight correspondences, the views do not pair up, a value is not finite, a
            weight is negative, the normaliser does not return two finite and invertible transforms :math:`(B, 3, 3)`,
            or ``rank2`` is neither ``"projection"`` nor ``"optimal"``.

    Reference:
        R. Hartley, In defense of the eight-point algorithm, TPAMI 1997; B. Fan, Y. Dai, Y. Seo, M. He, A revisit of the
        normalized eight-point algorithm and a self-supervised deep solution, section 3.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> points1, points2 = torch.rand(4, 8, 2) * 600, torch.rand(4, 8, 2) * 600
        >>> find_fundamental(points1, points2).shape
        torch.Size([4, 3, 3])

    """
    check_correspondences(points1, points2, weights)
    check_rank2(rank2)
    problem = LinearProblem.from_points(points1, points2, weights)
    return solve_fundamental(problem, Hartley() if normalizer is None else normalizer, rank2).to(points1.dtype)


def solve_fundamental(
    problem: LinearProblem, normalizer: Normalizer, rank2: Literal["projection", "optimal"] = "projection"
) -> Tensor:
    """Return the fundamental matrices of a problem; see :func:`find_fundamental`."""
    if rank2 == "optimal" and problem.x1.shape[1] == 8:
        return correct_rank2(problem, problem.null_matrix)
    return solve_in_coordinates(problem, *normalizing_transforms(normalizer, problem), rank2)


def solve_in_coordinates(
    problem: LinearProblem, T1: Tensor, T2: Tensor, rank2: Literal["projection", "optimal"] = "projection"
) -> Tensor:
    """Return the fundamental matrices of a problem under known transforms :math:`(B, 3, 3)` of the pixels."""
    F_hat, gap = problem.solve_in(T1, T2)
    if rank2 == "projection":
        F_mat = unit_fundamental(transform_fundamental(rank2_projection(F_hat), T1, T2))
    else:
        R1, R2 = torch.stack([T1, T2]) @ inverse(torch.stack([problem.T1, problem.T2]))
        F_mat = correct_rank2(problem, transform_fundamental(F_hat, R1, R2))
    if not needs_gradient(F_mat):
        return F_mat
    # Rounding chose among the solutions; one with an epipole on a point makes the loss as steep as rounding is small.
    return torch.where((gap > independence_gap(gap.dtype))[:, None, None], F_mat, F_mat.detach())
