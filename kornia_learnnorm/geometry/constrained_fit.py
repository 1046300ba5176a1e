"""Reweighted least squares under the singularity constraint: a fast way to a robust optimum.

Each step solves one linear system, a fraction of a step of Levenberg-Marquardt, and with a robust loss ends at an
optimum too. Nothing holds it there: of least squares with outliers, it may not converge.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.geometry.distances import DistanceScale, sampson_scale
from kornia_learnnorm.geometry.dlt import point_products, row_moments, row_products
from kornia_learnnorm.geometry.matrices import cofactors

Loss = Callable[[Tensor], tuple[Tensor, Tensor]]  # of squared distances: values and derivatives

EPIPOLE_FLOOR = 1e-4  # smallest norm of a line's normal, relative to the size of the points
STEP_LENGTH = 1.3  # over the least-squares step, which bounded losses make too short


class Fit(NamedTuple):
    """Fitted matrices and their costs."""

    F_mat: Tensor  # of unit norm, of F singular up to the square of the last step, (K, 3, 3)
    cost: Tensor  # sum of the last losses before the last step, (K,)
    gain: Tensor  # share of the cost that a least-squares step could still remove, (K,); small close to an optimum


def constrained_fit(
    x1: Tensor, x2: Tensor, F_mat: Tensor, losses: Iterable[Loss], scale: DistanceScale = sampson_scale
) -> Fit:
    r"""Return matrices (K, 3, 3) fitted to correspondences (3, N) that they share, one step for each of the losses.

    With :math:`u = \mathrm{vec}(F)`, :math:`\|u\| = 1`, :math:`\xi_i = x_{2,i} \otimes x_{1,i}`, the factors
    :math:`g_i(n_{1,i}, n_{2,i})` of the squared norms :math:`n_{v,i} = (u, V_{v,i} u)` of the epipolar lines' normals,
    the distances :math:`d_i = (u, \xi_i)\, g_i` and the cofactors :math:`u^\dagger` of :math:`F`, the gradient of its
    determinant, a step is

    .. math:: X &= \sum_i \rho'(d_i^2) \Big( g_i^2\, \xi_i \xi_i^\top + 2\, (u, \xi_i)^2\, g_i
              \sum_{v = 1, 2} \frac{\partial g_i}{\partial n_{v,i}} V_{v,i} \Big), \\
              u' &= \arg \operatorname*{stat}_{u'}\, (u', X u') \quad \text{subject to} \quad
              (u, u') = 1, \quad \det F + \alpha\, (u^\dagger, u' - u) = 0,

    followed by :math:`u \leftarrow N[u + \alpha\, (u' - u)]`, :math:`\alpha = 1.3`. The first step comes from afar:
    there :math:`\alpha = 1`, and the derivatives of :math:`g`, which could make :math:`X` indefinite, are left out.

    Points are homogeneous, the first two coordinates in pixels. Where a step cannot be computed, as without inliers,
    the given matrix comes back with an infinite cost. Fewer than seven inliers fit one of many matrices.

    Reference:
        W. Chojnacki, M. Brooks, A. van den Hengel, D. Gawley, On the fitting of surfaces to data with covariances,
        TPAMI 2000, for :math:`X`; K. Kanatani, Y. Sugaya, Compact fundamental matrix computation, IPSJ Transactions on
        Computer Vision and Applications 2, 2010, for schemes with the constraint.
    """
    losses = [*losses]
    if not losses:
        raise ValueError("constrained_fit needs a loss for each step, got none")
    given = F_mat / torch.linalg.vector_norm(F_mat, dim=(1, 2), keepdim=True)
    F, xi = given, (x2[:, None] * x1).flatten(0, 1)
    products1, products2 = ((x[:, None] * x).flatten(0, 1).mT for x in (x1, x2))
    products = row_products(point_products(x2, x1))
    # A point this close to the epipole has a line of no certain direction, and must not outweigh all others.
    floor1, floor2 = (EPIPOLE_FLOOR**2 * x.square().mean() for x in (x2, x1))
    system, right = F.new_zeros(len(F), 11, 11), F.new_zeros(len(F), 11)
    X, constraints, multipliers = system[:, :9, :9], system[:, 9:, :9], system[:, :9, 9:]
    entries = torch.unflatten(torch.unflatten(X, 2, (3, 3)), 1, (3, 3))
    in_view1, in_view2 = entries.diagonal(dim1=2, dim2=4)[..., :2], entries.diagonal(dim1=1, dim2=3)[..., :2]
    right[:, 9] = 1
    for step, loss in enumerate(losses):
        length = STEP_LENGTH if step else 1.0
        u, cofactor = F.flatten(1), cofactors(F).flatten(1)
        sq_norm1, sq_norm2 = (F.mT[:, :2] @ x2).square_().sum(1), (F[:, :2] @ x1).square_().sum(1)
        g, slope1, slope2 = scale(sq_norm1.clamp_(min=floor1), sq_norm2.clamp_(min=floor2))
        algebraic, g_squared = (u @ xi).square_(), g.square()
        values, weights = loss(algebraic * g_squared)
        X.copy_(row_moments(weights * g_squared, products))
        if step:
            pull = (2 * weights).mul_(algebraic).mul_(g)
            in_view1.add_(torch.unflatten((pull * slope1) @ products2, 1, (3, 3))[..., None])
            in_view2.add_(torch.unflatten((pull * slope2) @ products1, 1, (3, 3))[..., None])
        torch.stack([u, cofactor], 1, out=constraints)
        multipliers.copy_(constraints.mT)
        torch.mul((cofactor * u).sum(-1), 1 - 1 / (3 * length), out=right[:, 10])
        change = torch.linalg.solve_ex(system, right)[0][:, :9] - u
        u = torch.add(u, change, alpha=length)
        F = torch.unflatten(u / torch.linalg.vector_norm(u, dim=-1, keepdim=True), 1, (3, 3))
    found, cost = F.isfinite().all(-1).all(-1), values.sum(-1)
    gain = (change[:, None] @ X @ change[..., None])[:, 0, 0].abs_() / cost
    return Fit(torch.where(found[:, None, None], F, given), torch.where(found, cost, torch.inf), gain)
