"""Robust Levenberg-Marquardt over a model's manifold, batched: to convergence, or a fixed number of steps.

Coordinates are Hartley's up to the scale of homogeneous vectors: pixels relative to the centroid, with a third
coordinate of their size. Distances in them are distances in pixels.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.estimators.robust_losses import GemanMcClure, Loss
from kornia_learnnorm.geometry.checks import needs_gradient
from kornia_learnnorm.models.two_view_model import Residuals, State, TwoViewModel

FIRST_DAMPING = 1e-3  # damping of the first step, relative to the diagonal of the normal matrix
PLAIN_STEPS = 10  # steps before extrapolation starts
MIN_RATE, MAX_RATE = -0.5, 0.9  # bounds on the ratio of a step to the one before it
MAX_DAMPING = 1e8  # no step that is damped this much changes the cost by more than rounding
MIN_PIVOT = 1e-5  # smallest diagonal entry of the Cholesky factor of a definite Hessian, scaled to a unit diagonal
UNROLLED_LOSS = GemanMcClure()  # of distances over their scale
UNROLLED_SCALE = 3.0  # of the unrolled loss, in geometric means of the distances, corrected for the degrees of freedom
DISTANCE_FLOOR = 1e-5  # of the points' unit, added to distances before their logarithm


class RobustCost(NamedTuple):
    """Sum of losses over the correspondences of each matrix, or over one set that all matrices share."""

    model: Residuals
    x1: Tensor  # homogeneous points, the first two coordinates in pixels, (B or 1, 3, N)
    x2: Tensor
    weights: Tensor  # of the losses, (B or 1, N)
    loss: Loss  # of squared distances
    relaxation: float = 1.0  # factor on a step: a bounded loss has less curvature than its weights imply

    def select(self, rows: Tensor) -> "RobustCost":
        """Return the cost of some of the matrices."""
        if len(self.x1) == 1:
            return self
        return self._replace(x1=self.x1[rows], x2=self.x2[rows], weights=self.weights[rows])


class Optimum(NamedTuple):
    """States, costs, normal equations, convergence, damping of the next steps, number of steps tried, last step."""

    state: Any
    cost: Tensor
    normal: Tensor
    gradient: Tensor
    converged: Tensor
    damping: Tensor
    iterations: Tensor
    step: Tensor  # (B, P); zero after one that was refused

    def map(self, function: Callable[..., Tensor], *others: "Optimum") -> "Optimum":
        """Return the optimum with a function applied to each tensor and its counterparts in others."""
        states = zip(self.state, *(other.state for other in others), strict=True)
        state = type(self.state)(*(function(*values) for values in states))
        return Optimum(state, *(function(*values) for values in zip(self[1:], *(o[1:] for o in others), strict=True)))


def minimize(cost: RobustCost, state: State, max_iterations: int, tolerance: float) -> tuple[Tensor, Optimum]:
    """Return the costs at the initial states and the optima found from them, on the manifold of the states.

    Every matrix has a damping of its own and runs to convergence. For gradients, see :func:`attach_gradient`.
    """
    # In chunks whose intermediate results stay in the cache of a CPU: 2.5 times faster than all at once.
    matrices = state.matrix()
    size = max(1, (2**14 if matrices.device.type == "cpu" else 2**24) // cost.x1.shape[-1])
    if len(matrices) > size:
        found = []
        for rows in torch.split(torch.arange(len(matrices), device=matrices.device), size):
            part = type(state)(*(value[rows] for value in state))
            found.append(minimize(cost.select(rows), part, max_iterations, tolerance))
        costs, optima = zip(*found, strict=True)
        return torch.cat(costs), optima[0].map(lambda *values: torch.cat(values), *optima[1:])
    damping = matrices.new_full((len(matrices),), FIRST_DAMPING)
    start = _evaluate(cost, state, tolerance, damping, torch.zeros_like(damping, dtype=torch.int64))
    return start.cost, _descend(cost, start, max_iterations, tolerance)


def _descend(cost: RobustCost, best: Optimum, max_iterations: int, tolerance: float) -> Optimum:
    for iteration in range(max_iterations):
        active = ~best.converged & (best.damping < MAX_DAMPING)
        count = int(active.sum())
        if count == 0:
            break
        if 2 * count <= len(active):  # at most half go on
            rows = torch.nonzero(active)[:, 0]
            part = best.map(lambda value, rows=rows: value[rows])
            part = _descend(cost.select(rows), part, max_iterations - iteration, tolerance)
            return best.map(lambda value, new, rows=rows: value.index_copy(0, rows, new), part)
        best = _try_step(cost, best, active, tolerance)
    return best


def _try_step(cost: RobustCost, best: Optimum, active: Tensor, tolerance: float) -> Optimum:
    added = best.normal.diagonal(dim1=-2, dim2=-1) * best.damping[:, None]
    step = torch.linalg.solve_ex(best.normal + torch.diag_embed(added), best.gradient)[0]
    # The remaining steps are about a geometric series with the ratio of the last two (Aitken's extrapolation).
    rate = (step * best.step).sum(-1) / best.step.square().sum(-1).clamp(min=torch.finfo(step.dtype).tiny)
    rate = torch.where(best.iterations < PLAIN_STEPS, 0.0, rate.clamp(MIN_RATE, MAX_RATE))
    state = best.state.retract(-(cost.relaxation / (1 - rate))[:, None] * step)
    iterations = best.iterations + active
    moved = _evaluate(cost, state, tolerance, 0.1 * best.damping, iterations, step)
    better = active & (moved.cost < best.cost)  # not where either is NaN
    if better.all():
        return moved
    kept = best._replace(damping=10 * best.damping, iterations=iterations, step=torch.zeros_like(step))
    return moved.map(lambda new, old: torch.where(better.view(-1, *[1] * (new.ndim - 1)), new, old), kept)


def _evaluate(
    cost: RobustCost, state: State, tolerance: float, damping: Tensor, iterations: Tensor, step: Tensor | None = None
) -> Optimum:
    distance, J = cost.model.linearise(state.matrix(), cost.x1, cost.x2)
    total, normal, gradient, size = _normal_equations(cost, distance, J, state.tangents())
    diagonal = normal.diagonal(dim1=-2, dim2=-1).clamp_(min=torch.finfo(normal.dtype).tiny)
    # The cosines of the distances with their derivatives have no unit.
    flat = (gradient.square() <= tolerance**2 * size[:, None] * diagonal).all(-1)
    rounding = 4 * torch.finfo(normal.dtype).eps * (cost.x1[:, 2, 0] + cost.x2[:, 2, 0])  # of a distance
    converged = flat | (size <= rounding.square() * cost.weights.sum(-1))
    step = torch.zeros_like(gradient) if step is None else step
    return Optimum(state, total, normal, gradient, converged, damping, iterations, step)


def _normal_equations(
    cost: RobustCost, distance: Tensor, J: Tensor, D: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return costs (B,), normal matrices (B, P, P), gradients (B, P) and weighted sums of squares (B,).

    Arguments are distances (B, C N), their derivatives J by the matrices' entries, (B, 9, C N), and tangents (B, 9, P).
    """
    components = cost.model.components
    squares = distance.square() if components == 1 else cost.model.squares(distance)
    value, slope = cost.loss(squares)
    weights = slope * cost.weights
    total, size = (cost.weights * value).sum(-1), (weights * squares).sum(-1)
    along = D.mT @ J
    weighted = along * (weights if components == 1 else weights.repeat(1, components))[:, None]
    return total, weighted @ along.mT, (weighted @ distance[..., None])[..., 0], size


def attach_gradient(cost: RobustCost, optimum: Optimum) -> State:
    """Return the states of an optimum with derivatives by the implicit function theorem."""
    state: State = optimum.state
    step = optimum.gradient.new_zeros(optimum.gradient.shape).requires_grad_()
    residual = cost.model.residual(state.retract(step).matrix(), cost.x1, cost.x2)
    total = (cost.weights * cost.loss(cost.model.squares(residual))[0]).sum()
    (gradient,) = torch.autograd.grad(total, step, create_graph=True)
    rows = [torch.autograd.grad(g.sum(), step, retain_graph=True)[0] for g in gradient.unbind(-1)]
    hessian = torch.stack(rows, -2).detach()
    norms = hessian.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    norms = torch.where(norms > 0, norms, 1.0)
    root, failed = torch.linalg.cholesky_ex(hessian / (norms[:, :, None] * norms[:, None, :]))
    definite = (failed == 0) & (root.diagonal(dim1=-2, dim2=-1).amin(-1) > MIN_PIVOT)
    determined = (optimum.converged & definite)[:, None]
    hessian = torch.where(determined[..., None], hessian, torch.eye(step.shape[1]).to(hessian))
    return state.retract(-torch.linalg.solve(hessian, torch.where(determined, gradient - gradient.detach(), 0.0)))


def refine_unrolled(model: TwoViewModel, x1: Tensor, x2: Tensor, M: Tensor, weights: Tensor, steps: int) -> Tensor:
    r"""Return matrices after steps of Levenberg-Marquardt on :math:`\sum_i w_i\, \rho(d_i / s)`, differentiable.

    :math:`d` are the model's distances and :math:`\rho(u) = u^2 / (1 + u^2)` is Geman and McClure's loss. Its scale is
    :math:`s = 3 \bar d \sqrt{n / (n - p)}`, with the weighted geometric mean :math:`\bar d` of the distances under the
    given matrices, :math:`n = (\sum_i w_i)^2 / \sum_i w_i^2` effective correspondences, at least :math:`p + 1`, and
    :math:`p` parameters: a matrix that was fitted to few correspondences leaves distances that are too small. A step is
    taken where it lowers the cost.

    Points are homogeneous, :math:`(B, 3, N)`, of about unit size; weights :math:`(B, N)` are zero for absent ones;
    matrices :math:`(B, 3, 3)` may have any scale but zero.
    """
    total_weight = weights.sum(1, keepdim=True)
    share = weights / (total_weight + (total_weight == 0))
    state: State = differentiable_state(model, M / torch.linalg.matrix_norm(M, keepdim=True))
    distance, J = model.linearise(state.matrix(), x1, x2, share)
    squares = distance.square() if model.components == 1 else model.squares(distance)
    geometric_mean = (share * (squares + DISTANCE_FLOOR**2).log() / 2).sum(1, keepdim=True).exp()
    concentration = share.square().sum(1, keepdim=True)
    number = (1 / (concentration + (concentration == 0))).clamp(min=model.dof + 1.0)  # of effective correspondences
    scale = UNROLLED_SCALE * geometric_mean * (number / (number - model.dof)).sqrt()
    cost = RobustCost(model, x1, x2, share, UNROLLED_LOSS)
    distance, J = distance / scale, J / scale[..., None]
    total, normal, gradient, _ = _normal_equations(cost, distance, J, state.tangents())
    damping, eye = torch.full_like(scale, FIRST_DAMPING), torch.eye(model.dof, dtype=normal.dtype, device=normal.device)
    for _ in range(steps):
        # All directions are damped equally, so that swapping the views has no effect.
        size = normal.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
        size = size + (size == 0)
        moved = state.retract(-torch.linalg.solve_ex(normal + (damping * size)[..., None] * eye, gradient)[0])
        distance, J = model.linearise(moved.matrix(), x1, x2, share)
        distance, J = distance / scale, J / scale[..., None]
        new_total, new_normal, new_gradient, _ = _normal_equations(cost, distance, J, moved.tangents())
        better = (new_total < total)[:, None]  # false where it is NaN
        state = choose(better[:, 0], moved, state)
        total, gradient = torch.where(better[:, 0], new_total, total), torch.where(better, new_gradient, gradient)
        normal = torch.where(better[..., None], new_normal, normal)
        damping = torch.where(better, 0.1 * damping, 10 * damping)
    return state.matrix()


def choose(chosen: Tensor, states: Any, others: Any) -> Any:
    """Return the states where ``chosen``, (B,) bool, is true, and the others elsewhere."""
    tensors = []
    for own, other in zip(states, others, strict=True):
        mask = chosen.view(-1, *[1] * (own.ndim - 1))
        tensors.append(own if own is other else torch.where(mask, own, other))
    return type(states)(*tensors)


def differentiable_state(model: TwoViewModel, M: Tensor) -> Any:
    """Return the states of matrices of unit norm, differentiable along the manifold."""
    with torch.no_grad():
        state = model.state(M)
    if not needs_gradient(M):
        return state
    D, size = state.tangents(), torch.linalg.matrix_norm(state.matrix())[:, None]
    change = size * (M - M.detach()).mT.flatten(1)  # zero, but for its derivative
    return state.retract(torch.linalg.solve_ex(D.mT @ D, D.mT @ change[..., None])[0].squeeze(-1))
