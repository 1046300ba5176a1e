r"""Reweighted least squares under the singularity constraint: a fast way close to a robust optimum.

Each step holds the weights, which turn squared algebraic residuals into losses of distances, and solves one linear
system for the matrix that minimises their sum on the linearised constraint. It needs none of the derivatives of the
distances, so that a step is a fraction of one of Levenberg-Marquardt, and ends next to the same optimum.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from kornia_learnnorm.objectives import Factor, Loss, factor_alone, sampson_factor

__all__ = ["constrained_fit"]


def constrained_fit(
    x1: Tensor,
    x2: Tensor,
    F_mat: Tensor,
    losses: Iterable[Loss],
    factor: Factor = sampson_factor,
) -> Tensor:
    r"""Fit matrices to correspondences that they share, one step for each loss.

    With :math:`u = \mathrm{vec}(F)`, :math:`\|u\| = 1`, :math:`\xi_i = x_{2,i} \otimes x_{1,i}`, the distances
    :math:`d_i = (u, \xi_i)\, g_i` and the cofactors :math:`u^\dagger` of :math:`F`, the gradient of its determinant, a
    step is

    .. math:: \min_v \sum_i \rho'(d_i^2)\, g_i^2\, (v, \xi_i)^2 \quad \text{subject to} \quad
              (u, v) = 1, \quad \det F + (u^\dagger, v - u) = 0,

    followed by :math:`u \leftarrow v / \|v\|`.

    Args:
        x1: homogeneous points of view 1 with shape :math:`(3, N)`, the first two coordinates in pixels.
        x2: the same of view 2.
        F_mat: where to start, with shape :math:`(K, 3, 3)`, any scale but zero.
        losses: :math:`\rho` of each step, see :mod:`kornia_learnnorm.objectives`.
        factor: :math:`g`, see :mod:`kornia_learnnorm.objectives`.

    Returns:
        matrices of unit norm with shape :math:`(K, 3, 3)`; singular up to the square of the last step. Where a step
        cannot be computed, as with fewer than seven inliers, the matrix that was given.

    Reference:
        K. Kanatani, Y. Sugaya, Compact fundamental matrix computation, IPSJ Transactions on Computer Vision and
        Applications 2, 2010, compares schemes of this kind.

    """
    given = F_mat / torch.linalg.matrix_norm(F_mat, keepdim=True)
    F, xi = given, (x2[:, None] * x1).flatten(0, 1)
    products = (xi[:, None] * xi).flatten(0, 1).mT
    floor = torch.finfo(F.dtype).eps ** 2  # below it the direction of a line is rounding
    system, right = F.new_zeros(len(F), 11, 11), F.new_zeros(len(F), 11)
    moments, constraints, multipliers = system[:, :9, :9], system[:, 9:, :9], system[:, :9, 9:]
    right[:, 9] = 1
    for loss in losses:
        u, cofactors = F.flatten(1), torch.linalg.cross(F.roll(-1, 1), F.roll(-2, 1)).flatten(1)
        normal1, normal2 = (F.mT[:, :2] @ x2).square_().sum(1), (F[:, :2] @ x1).square_().sum(1)
        g = factor_alone(factor, normal1.clamp_(min=floor), normal2.clamp_(min=floor)).square()
        w = loss((u @ xi).square_().mul_(g))[1] * g
        sums = torch.unflatten(w @ products, 1, (9, 9))
        torch.div(sums, sums.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None], out=moments)
        torch.stack([u, cofactors], 1, out=constraints)
        multipliers.copy_(constraints.mT)
        torch.mul((cofactors * u).sum(-1), 2 / 3, out=right[:, 10])
        v = torch.linalg.solve_ex(system, right)[0][:, :9]
        F = torch.unflatten(v / v.norm(dim=-1, keepdim=True), -1, (3, 3))
    return torch.where(F.isfinite().all(-1).all(-1)[:, None, None], F, given)
