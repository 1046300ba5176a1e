r"""A few robust steps of Levenberg-Marquardt on the manifold of matrices of rank 2, differentiable by unrolling.

:func:`~kornia_learnnorm.refine_fundamental` runs to convergence, where the gradient is implicit; this is a fixed number
of steps, the same for all sets, in one graph, as a layer needs that is compiled or mapped.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_learnnorm.geometry.checks import safe_divisor, weighted_mean
from kornia_learnnorm.geometry.manifold import Rank2, decompose, retract, tangents

__all__ = ["refine_weighted"]

SCALE = 3.0  # of the robust loss over the geometric mean of the distances, corrected for the parameters
PARAMETERS = 7  # of a fundamental matrix
FIRST_DAMPING = 1e-3  # of the mean diagonal entry of the normal matrix, added to all in the first step
NORMAL_FLOOR = 1e-4  # of the mean norm of the lines' normals, added to each
DISTANCE_FLOOR = 1e-5  # of the frame's unit, added to distances before their logarithm


def refine_weighted(x1: Tensor, x2: Tensor, F_mat: Tensor, weights: Tensor, steps: int) -> Tensor:
    r"""Return matrices after steps of Levenberg-Marquardt on :math:`\sum_i w_i\, \rho(d_i / s)`.

    :math:`d` are Sampson distances and :math:`\rho(u) = u^2 / (1 + u^2)` is Geman and McClure's loss. Its scale is
    :math:`s = 3 \bar d \sqrt{n / (n - 7)}`, with the weighted geometric mean :math:`\bar d` of the distances under the
    given matrices and :math:`n = (\sum_i w_i)^2 / \sum_i w_i^2` effective correspondences: a matrix of seven parameters
    that was fitted to few of them leaves distances that are too small. A step is taken where it lowers the cost.

    Args:
        x1: homogeneous points of the first view with shape :math:`(B, N, 3)`, of about unit size.
        x2: homogeneous points of the second view.
        F_mat: matrices of rank 2 with shape :math:`(B, 3, 3)`, any scale but zero.
        weights: non-negative weights with shape :math:`(B, N)`; zero means absent.
        steps: number of steps.

    Returns:
        matrices of rank 2 and unit norm with shape :math:`(B, 3, 3)`.

    """
    state = _differentiable_state(F_mat / torch.linalg.matrix_norm(F_mat, keepdim=True))
    distance, J = _linearise(x1, x2, state.matrix(), weights)
    scale = SCALE * _geometric_mean(distance, weights) * _degrees_of_freedom_factor(weights)
    cost, damping = _cost(distance, weights, scale), torch.full_like(scale, FIRST_DAMPING)
    for _ in range(steps):
        moved = retract(state, _step(distance / scale, J @ tangents(state) / scale[..., None], weights, damping))
        new_distance, new_J = _linearise(x1, x2, moved.matrix(), weights)
        new_cost = _cost(new_distance, weights, scale)
        better = new_cost < cost  # false where it is NaN
        state = Rank2(*(_choose(better, new, old) for new, old in zip(moved, state, strict=True)))
        distance, J = _choose(better, new_distance, distance), _choose(better, new_J, J)
        cost = _choose(better, new_cost, cost)
        damping = torch.where(better[:, None], 0.1 * damping, 10 * damping)
    return state.matrix()


def _step(distance: Tensor, J: Tensor, weights: Tensor, damping: Tensor) -> Tensor:
    """Return a damped step (B, 7) from distances (B, N) and their derivatives (B, N, 7), both over the scale."""
    weighted = J * (weights / (1 + distance.square()).square())[..., None]
    normal, gradient = weighted.mT @ J, (weighted * distance[..., None]).sum(1)
    # The same for all directions, so that it does not depend on which view comes first.
    size = safe_divisor(normal.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True))
    eye = torch.eye(7, dtype=normal.dtype, device=normal.device)
    damped = normal + (damping * size)[..., None] * eye
    step: Tensor = -torch.linalg.solve_ex(damped, gradient[..., None])[0].squeeze(-1)
    return step


def _choose(rows: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Return the new values of the sets marked in ``rows``, (B,), and the old ones of the others."""
    return torch.where(rows.view(-1, *[1] * (new.ndim - 1)), new, old)


def _differentiable_state(F_mat: Tensor) -> Rank2:
    """Return the states of matrices of rank 2 and unit norm, with the derivatives that a step on the manifold has."""
    with torch.no_grad():
        state = decompose(F_mat)
        D = tangents(state)
    change = (F_mat - F_mat.detach()).mT.flatten(1)  # zero, but for its derivative
    step = torch.linalg.solve_ex(D.mT @ D, D.mT @ change[..., None])[0].squeeze(-1)
    return retract(state, step)


def _linearise(x1: Tensor, x2: Tensor, F: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return Sampson distances with signs, (B, N), and their derivatives by the entries, column-major, (B, N, 9)."""
    line1, line2 = x2 @ F, x1 @ F.mT
    mask = line1.new_tensor([1.0, 1.0, 0.0])
    normal1, normal2 = line1 * mask, line2 * mask
    square = normal1.square().sum(-1) + normal2.square().sum(-1)
    square = square + NORMAL_FLOOR**2 * weighted_mean(square[..., None], weights)
    algebraic, factor = (x2 * line2).sum(-1), safe_divisor(square).rsqrt()
    distance = algebraic * factor
    pull = (distance * factor.square())[..., None]
    # d(distance) = x2^T dF x1 factor - pull (x2^T dF normal1 + normal2^T dF x1)
    right = factor[..., None] * x1 - pull * normal1
    J = right[..., :, None] * x2[..., None, :] - x1[..., :, None] * (pull * normal2)[..., None, :]
    return distance, J.flatten(-2)


def _geometric_mean(distance: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted geometric mean of distances, (B, 1)."""
    logarithm = (distance.square() + DISTANCE_FLOOR**2).log() / 2
    return weighted_mean(logarithm[..., None], weights).exp()


def _degrees_of_freedom_factor(weights: Tensor) -> Tensor:
    """Return the square root of the effective number of correspondences over its excess of the parameters, (B, 1).

    Sets of eight effective correspondences or fewer have one degree of freedom.
    """
    relative = weights / safe_divisor(weights.detach().amax(1, keepdim=True))  # their squares stay within the range
    number = relative.sum(1, keepdim=True).square() / safe_divisor(relative.square().sum(1, keepdim=True))
    number = number.clamp(min=PARAMETERS + 1.0)
    return (number / (number - PARAMETERS)).sqrt()


def _cost(distance: Tensor, weights: Tensor, scale: Tensor) -> Tensor:
    """Return the weighted sum of losses, (B,)."""
    square = (distance / scale).square()
    return (weights * square / (1 + square)).sum(-1)
