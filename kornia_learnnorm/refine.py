r"""Non-linear refinement of fundamental matrices: Levenberg-Marquardt on distances in pixels, batched.

A matrix of rank 2 is kept as :math:`\hat F = U_{:,1:2}\, A\, V_{:,1:2}^\top` with rotations :math:`U, V` and a
:math:`2 \times 2` matrix :math:`A` of unit norm, in Hartley's coordinates. A step has seven parameters: two tilt the
last axis, the epipole, of each rotation, and three turn :math:`A` on the unit sphere. Two rotations and the ratio of
the singular values are seven as well, but no coordinates where those are equal, as under pure forward motion.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.correspondences import check_correspondences, solve_dtype
from kornia_learnnorm.normalizers import Hartley
from kornia_learnnorm.objectives import Factor, Loss, sampson_factor, squared_loss
from kornia_learnnorm.optimal_rank2 import check_fundamental
from kornia_learnnorm.transforms import transform_fundamental

__all__ = ["Refinement", "refine_fundamental"]


class Refinement(NamedTuple):
    """Refined fundamental matrices and how they were reached.

    Attributes:
        F_mat: fundamental matrices of rank 2 and unit Frobenius norm, (B, 3, 3).
        cost_before: weighted sum of the losses in square pixels at the given matrices, projected to rank 2, (B,).
        cost: the same at ``F_mat``, never larger, (B,).
        iterations: steps tried, (B,) int64.
        converged: whether the gradient vanishes, up to 1e-7 of what its terms could sum to, (B,) bool.
    """

    F_mat: Tensor
    cost_before: Tensor
    cost: Tensor
    iterations: Tensor
    converged: Tensor


def refine_fundamental(
    points1: Tensor,
    points2: Tensor,
    F_mat: Tensor,
    weights: Tensor | None = None,
    factor: Factor = sampson_factor,
    loss: Loss = squared_loss,
    max_iterations: int = 50,
) -> Refinement:
    r"""Refine fundamental matrices to a local minimum of a sum over the correspondences, by Levenberg-Marquardt.

    .. math:: \min_{\mathrm{rank} F = 2} \sum_i w_i\, \rho(d_i^2), \quad d_i = x_{2,i}^\top F x_{1,i} \,
              g\big(\|(F^\top x_{2,i})_{1:2}\|^2, \|(F x_{1,i})_{1:2}\|^2\big)

    Each element of the batch has its own damping; a step is taken where it lowers the cost and refused where it does
    not or cannot be computed, so that :math:`F` is at worst what was given.

    The result is differentiable, once, in points and weights: by the implicit function theorem,
    :math:`\mathrm dp = -H^{-1} \mathrm d(\nabla_p\, \mathrm{cost})` with the exact Hessian :math:`H`. It does not
    depend on ``F_mat``. Elements that did not converge or whose :math:`H` is not positive definite carry no gradient.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        F_mat: where to start, with shape :math:`(B, 3, 3)`, any scale but zero; of rank 3, it is first projected in
            Hartley's coordinates.
        weights: optional non-negative weights :math:`(B, N)` of the losses; zero means absent.
        factor: :math:`g`, from the algebraic residual to a distance in pixels:
            :func:`~kornia_learnnorm.objectives.sampson_factor` or
            :func:`~kornia_learnnorm.objectives.symmetric_factor`.
        loss: :math:`\rho` of squared distances: :func:`~kornia_learnnorm.objectives.squared_loss`,
            :class:`~kornia_learnnorm.objectives.Huber`, :class:`~kornia_learnnorm.objectives.Cauchy` or
            :class:`~kornia_learnnorm.objectives.GemanMcClure`.
        max_iterations: largest number of steps tried.

    Returns:
        the matrices with their costs, in the dtype of the points; costs carry no gradient.

    Raises:
        TypeError: if an argument is not a floating-point tensor or the points are not of one dtype.
        ShapeError: if a shape is wrong.
        ValueError: if there are fewer than eight correspondences, shapes do not pair up, a value is not finite, a
            matrix is zero, or ``max_iterations`` is negative.

    Reference:
        A. Bartoli, P. Sturm, Nonlinear estimation of the fundamental matrix with minimal parameters, TPAMI 2004; R.
        Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, section 11.4.3 and appendix 6.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> points1, points2 = torch.rand(4, 20, 2) * 600, torch.rand(4, 20, 2) * 600
        >>> refinement = refine_fundamental(points1, points2, torch.rand(4, 3, 3))
        >>> bool((refinement.cost < refinement.cost_before).all())
        True

    """
    check_correspondences(points1, points2, weights)
    check_fundamental(F_mat, points1)
    if max_iterations < 0:
        raise ValueError(f"max_iterations must be >= 0, got {max_iterations}")
    dtype = solve_dtype(points1.device)
    x1, x2 = points1.to(dtype), points2.to(dtype)
    w = torch.ones_like(x1[..., 0]) if weights is None else weights.to(dtype)
    with torch.no_grad():
        # The optimum does not depend on the coordinates in which it is sought.
        T1, T2 = Hartley()(x1, x2, w)
        F = transform_fundamental(F_mat.to(dtype), torch.linalg.inv_ex(T1)[0], torch.linalg.inv_ex(T2)[0])
    x1, x2 = convert_points_to_homogeneous(x1) @ T1.mT, convert_points_to_homogeneous(x2) @ T2.mT
    problem = _Problem(x1, x2, w, T1[:, :1, 0], T2[:, :1, 0], factor, loss)
    with torch.no_grad():
        state = _decompose(F)
        before = _evaluate(problem, state).cost
        best, iterations = _minimise(problem, state, max_iterations)
        state = _State(*best[:3])
    if torch.is_grad_enabled() and (x1.requires_grad or x2.requires_grad or w.requires_grad):
        state = _attach_gradient(problem, best)
    F = transform_fundamental(_matrix(state), T1, T2)
    F = F / torch.linalg.matrix_norm(F, keepdim=True)
    dtype = points1.dtype
    return Refinement(F.to(dtype), before.to(dtype), best.cost.to(dtype), iterations, best.converged)


class _Problem(NamedTuple):
    """Homogeneous points in Hartley's coordinates (B, N, 3), weights (B, N), both scales (B, 1), and the objective."""

    x1: Tensor
    x2: Tensor
    weights: Tensor
    scale1: Tensor
    scale2: Tensor
    factor: Factor
    loss: Loss

    def select(self, rows: Tensor) -> _Problem:
        tensors = (self.x1[rows], self.x2[rows], self.weights[rows], self.scale1[rows], self.scale2[rows])
        return _Problem(*tensors, self.factor, self.loss)


class _State(NamedTuple):
    """Matrices of rank 2: rotations of both views (B, 3, 3) and the unit matrix between them (B, 2, 2)."""

    U: Tensor
    A: Tensor
    V: Tensor


class _Estimate(NamedTuple):
    """States and their cost, normal equations of columns scaled to unit norm, those norms, and convergence."""

    U: Tensor
    A: Tensor
    V: Tensor
    cost: Tensor
    normal: Tensor
    gradient: Tensor
    norms: Tensor
    converged: Tensor


def _decompose(F: Tensor) -> _State:
    U, s, Vh = torch.linalg.svd(F)
    return _State(U, torch.diag_embed(normalize(s[..., :2], dim=-1)), Vh.mT)


def _minimise(problem: _Problem, state: _State, max_iterations: int) -> tuple[_Estimate, Tensor]:
    """Return the best estimates and the number of steps tried for each."""
    best = _evaluate(problem, state)
    damping = torch.full_like(best.cost, 1e-3)
    iterations = torch.zeros_like(best.cost, dtype=torch.int64)
    for _ in range(max_iterations):
        # No step that is damped this much changes the cost by more than rounding.
        rows = torch.nonzero(~best.converged & (damping < 1e8))[:, 0]
        if len(rows) == 0:
            break
        current = _Estimate(*(value[rows] for value in best))
        step = _step(current, damping[rows])
        candidate = _evaluate(problem.select(rows), _retract(_State(*current[:3]), step))
        better = candidate.cost < current.cost  # not where either is NaN
        for value, update in zip(best, candidate, strict=True):
            value[rows[better]] = update[better]
        damping[rows] *= torch.where(better, 0.1, 10.0)
        iterations[rows] += 1
    return best, iterations


def _step(estimate: _Estimate, damping: Tensor) -> Tensor:
    damped = estimate.normal + torch.diag_embed(damping[:, None].expand_as(estimate.gradient))
    step: Tensor = -torch.linalg.solve_ex(damped, estimate.gradient)[0] / estimate.norms
    return step


def _evaluate(problem: _Problem, state: _State) -> _Estimate:
    distance, J = _linearise(problem, state)
    value, weights = problem.loss(distance.square())
    weights = weights * problem.weights
    WJ = weights[..., None] * J
    normal, gradient = J.mT @ WJ, (WJ.mT @ distance[..., None]).squeeze(-1)
    norms = _positive(normal.diagonal(dim1=-2, dim2=-1).sqrt())
    normal, gradient = normal / (norms[:, :, None] * norms[:, None, :]), gradient / norms
    # The gradient is that of the columns' cosines with the distances, so this test knows no unit.
    size = (weights * distance.square()).sum(-1).sqrt()
    rounding = 4 * torch.finfo(size.dtype).eps * (1 / problem.scale1 + 1 / problem.scale2)[:, 0]
    exact = size <= rounding * problem.weights.sum(-1).sqrt()
    converged = exact | (gradient.abs().amax(-1) <= 1e-7 * size)
    cost = (problem.weights * value).sum(-1)
    return _Estimate(*state, cost, normal, gradient, norms, converged)


def _linearise(problem: _Problem, state: _State) -> tuple[Tensor, Tensor]:
    """Signed distances in pixels (B, N) and their derivatives (B, N, 7) by a step, see `_retract`."""
    distance, alpha, beta = _distances(problem, _matrix(state))
    # In the axes of U and V, where a tilt moves the last row or column and the turn moves the rest.
    alpha, beta, y1, y2 = alpha @ state.U, beta @ state.V, problem.x1 @ state.V, problem.x2 @ state.U
    K = alpha[..., :, None] * y1[..., None, :] + y2[..., :, None] * beta[..., None, :]
    tilt2, tilt1 = K[..., 2, :2] @ state.A.mT, K[..., :2, 2] @ state.A
    return distance, torch.cat([tilt2, tilt1, K[..., :2, :2].flatten(-2) @ _tangents(state.A).mT], -1)


def _distances(problem: _Problem, F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return signed distances (B, N) in pixels and :math:`\alpha, \beta` (B, N, 3).

    A change of :math:`F` changes the distances by :math:`\alpha^\top \mathrm dF\, x_1 + x_2^\top \mathrm dF\, \beta`.
    """
    line1, line2 = problem.x2 @ F, problem.x1 @ F.mT
    algebraic = (problem.x2 * line2).sum(-1)
    # A line of normalised coordinates times the scale of its view has the normal that it has in pixels.
    square1, square2 = (s[..., None].square() * F.new_tensor([1.0, 1.0, 0.0]) for s in (problem.scale1, problem.scale2))
    floor = torch.finfo(F.dtype).eps ** 2  # below it the direction of a line is rounding
    normal1 = (square1 * line1.square()).sum(-1).clamp(min=floor)
    normal2 = (square2 * line2.square()).sum(-1).clamp(min=floor)
    factor, slope1, slope2 = problem.factor(normal1, normal2)
    alpha = factor[..., None] * problem.x2 + (2 * algebraic * slope2)[..., None] * square2 * line2
    return algebraic * factor, alpha, (2 * algebraic * slope1)[..., None] * square1 * line1


def _matrix(state: _State) -> Tensor:
    return state.U[..., :2] @ state.A @ state.V[..., :2].mT


def _retract(state: _State, step: Tensor) -> _State:
    """Take a step (B, 7): tilts of view 2 and of view 1, and a turn of the matrix between them."""
    tilt2, tilt1, turn = torch.split(step, [2, 2, 3], -1)
    a = state.A.flatten(-2) + (turn[..., None, :] @ _tangents(state.A)).squeeze(-2)
    A = torch.unflatten(normalize(a, dim=-1), -1, (2, 2))
    return _State(state.U @ _rotation(tilt2), A, state.V @ _rotation(tilt1))


def _rotation(tilt: Tensor) -> Tensor:
    """Rotations (B, 3, 3) by Cayley's map, which agrees with the exponential to second order and has no sine."""
    a, b = tilt.unbind(-1)
    zero = torch.zeros_like(a)
    S = torch.unflatten(torch.stack([zero, zero, -a, zero, zero, -b, a, b, zero], -1), -1, (3, 3))
    eye = torch.eye(3, dtype=tilt.dtype, device=tilt.device)
    return eye + (S + S @ S / 2) / (1 + tilt.square().sum(-1)[..., None, None] / 4)


def _tangents(A: Tensor) -> Tensor:
    """Orthonormal directions (B, 3, 4) orthogonal to unit matrices: i, j and k times A, read as a quaternion."""
    a, b, c, d = A.flatten(-2).unbind(-1)
    return torch.unflatten(torch.stack([-b, a, -d, c, -c, d, a, -b, -d, -c, b, a], -1), -1, (3, 4))


def _attach_gradient(problem: _Problem, estimate: _Estimate) -> _State:
    """Return the same states with the derivatives that the optimum has by the implicit function theorem."""
    state = _State(*estimate[:3])
    step = torch.zeros_like(estimate.gradient).requires_grad_()
    distance = _distances(problem, _matrix(_retract(state, step)))[0]
    cost = (problem.weights * problem.loss(distance.square())[0]).sum()
    (gradient,) = torch.autograd.grad(cost, step, create_graph=True)
    rows = [torch.autograd.grad(g.sum(), step, retain_graph=True)[0] for g in gradient.unbind(-1)]
    hessian = torch.stack(rows, -2).detach()
    norms = _positive(hessian.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt())
    root, failed = torch.linalg.cholesky_ex(hessian / (norms[:, :, None] * norms[:, None, :]))
    definite = (failed == 0) & (root.diagonal(dim1=-2, dim2=-1).amin(-1) > 1e-5)
    determined = (estimate.converged & definite)[:, None]
    hessian = torch.where(determined[..., None], hessian, torch.eye(7).to(hessian))
    change = torch.where(determined, gradient - gradient.detach(), 0.0)
    return _retract(state, -torch.linalg.solve(hessian, change))


def _positive(values: Tensor) -> Tensor:
    return torch.where(values > 0, values, 1.0)
