r"""The stages of the learned relative pose: features, logits, moment matrix, essential matrices, robust steps.

Correspondences enter the solution through the :math:`9 \times 9` matrix of the second moments of their design rows
alone, :math:`\sum_i w_i a_i a_i^\top`: what follows costs the same for ten matches and for thousands.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import cross_product_matrix
from torch import Tensor, nn

from kornia_learnnorm.estimators.match_features import (
    POINT_FEATURES,
    RESIDUAL_FEATURES,
    CommonFrame,
    match_features,
    residual_features,
)
from kornia_learnnorm.estimators.optimize import UNROLLED_LOSS
from kornia_learnnorm.geometry.five_point import essential_in_span
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.essential import Calibrated, Essential, nearest_essential

__all__ = ["POSE_OUTPUTS", "POSE_POINT_FEATURES", "POSE_RESIDUAL_FEATURES", "run_pose_stages"]

POSE_POINT_FEATURES, POSE_RESIDUAL_FEATURES = POINT_FEATURES + 5, RESIDUAL_FEATURES + 1
POSE_OUTPUTS = 1  # of a stage's network for the whole set: the logarithm of the robust scale's factor
EARLY_STEPS, LOCAL_STEPS = 2, 6  # reweightings in all stages but the last, and of the last stage's candidates
# Scales of the robust loss in geometric means of the distances, times the network's factor.
EARLY_SCALE, LAST_SCALE = 3.0, 0.7
SCALE_BOUND = 1.5  # the logarithm of the factor stays within plus and minus this
LAST_POWER = 0.1  # of the weights in the last stage: most matches are to count, and a robust loss drops outliers
RELAXATION = 1.3  # of a step: the curvature of a robust loss is less than its weights
EARLY_PIXELS, LAST_PIXELS = 2.0, 0.7  # scales of the losses that candidates are compared by
PIXEL_FLOOR = 1e-3  # pixels, added to distances before their logarithm
NORMAL_FLOOR = 1e-4  # of the root mean square norm of the lines' normals, added to each
MIN_WEIGHT = 1e-6  # added to weights of which the largest is one
DAMPING = 1e-9  # of the mean diagonal of the normal matrix, added to it
GOLDEN = 1.1347241384015194  # root of x^6 = x + 1: multiples of its powers spread evenly (M. Roberts, 2018)
MAX_SCORED = 256  # matches by which the matrices of minimal samples are compared first
SHORTLIST = 4  # matrices of minimal samples that are compared on all matches


class _Evidence(NamedTuple):
    """Correspondences of calibrated views, and what their distances under essential matrices are made of."""

    model: Essential  # in the frame
    rows: Tensor  # of the design matrix of directions, for the column-major entries of E, (B, 9, N)
    products: Tensor  # x1 x1^T and x2 x2^T of points in the frame, for the squared normals of lines, (B, 18, N)
    rays: Tensor  # directions in view 1 and in view 2, (B, 6, N)
    unit: Tensor  # of the frame, in pixels, (B, 1)

    @classmethod
    def from_frame(cls, model: Essential, frame: CommonFrame, x1: Tensor, x2: Tensor) -> _Evidence:
        """Return the evidence of homogeneous points (B, 3, N) in the frame."""
        rays = torch.cat([model.C1 @ x1, model.C2 @ x2], 1)
        rows = (rays[:, :3, None] * rays[:, None, 3:]).flatten(1, 2)
        products = torch.cat([(x[:, :, None] * x[:, None]).flatten(1, 2) for x in (x1, x2)], 1)
        return cls(model, rows, products, rays, frame.inverse[:, 0, 0, None])

    def select(self, index: Tensor) -> _Evidence:
        """Return the correspondences of given indices (B, M)."""
        rows, products = (v.gather(2, index[:, None].expand(-1, v.shape[1], -1)) for v in (self.rows, self.products))
        return self._replace(rows=rows, products=products)

    def repeat(self, number: int) -> _Evidence:
        """Return each set so many times."""
        model = Essential(*(C.repeat_interleave(number, 0) for C in (self.model.C1, self.model.C2)))
        return _Evidence(model, *(values.repeat_interleave(number, 0) for values in self[1:]))

    def single(self) -> _Evidence:
        """Return the same in float32, which is enough to compare matrices."""
        model = Essential(self.model.C1.float(), self.model.C2.float())
        return _Evidence(model, *(values.float() for values in self[1:]))

    def squares(self, E_mat: Tensor) -> tuple[Tensor, Tensor]:
        """Return squared Sampson distances under matrices (B, S, 3, 3) and gradient factors, each (B, S, N).

        Distances are in the frame's unit; the factors turn squared algebraic residuals into their squares.
        """
        F_mat = self.model.C2.mT[:, None] @ E_mat @ self.model.C1[:, None]
        forms = torch.stack([F_mat[:, :, :2].mT @ F_mat[:, :, :2], F_mat[..., :2] @ F_mat[..., :2].mT], 2).flatten(2)
        norms = forms @ self.products
        factor = 1 / (norms + (NORMAL_FLOOR**2 * norms.mean(-1, keepdim=True) + torch.finfo(norms.dtype).tiny))
        return (E_mat.mT.flatten(2) @ self.rows).square() * factor, factor

    def losses(self, E_mat: Tensor, pixels: float) -> Tensor:
        """Return Geman and McClure's loss (B, S, N) of a scale in pixels."""
        return UNROLLED_LOSS(self.squares(E_mat)[0] * (self.unit[:, None] / pixels).square())[0]

    def in_front(self, state: Calibrated, weights: Tensor) -> Tensor:
        """Return which matches are in front of both cameras, (B, N) bool, under the pose of most weight (B, N)."""
        R, t = state.rotations(), state.axes[:, 0, :, 2:]
        between = R.mT.flatten(2) @ self.rows  # x2^T R x1, (B, 2, N)
        along1, along2 = (R[:, 0].mT @ t).mT @ self.rays[:, :3], t.mT @ self.rays[:, 3:]  # of either R, (B, 1, N)
        square1, square2 = torch.unflatten(self.rays.square(), 1, (2, 3)).sum(2)[:, :, None].unbind(1)
        depth1, depth2 = along2 * between - along1 * square2, along2 * square1 - along1 * between
        front = torch.cat([(depth1 > 0) & (depth2 > 0), (depth1 < 0) & (depth2 < 0)], 1)
        best = (front.to(weights) @ weights[..., None]).argmax(1, keepdim=True)
        return front.gather(1, best.expand(-1, 1, front.shape[-1]))[:, 0]

    def moments(self, weights: Tensor) -> Tensor:
        """Return the second moments of the design rows under weights (B, S, N), (B, S, 9, 9)."""
        return (self.rows[:, None] * weights[:, :, None]) @ self.rows.mT[:, None]

    def normal_moments(self, weights: Tensor) -> Tensor:
        """Return the quadratic form (B, 9, 9) of E's entries that sums the lines' squared normals, weighted (B, N)."""
        sums = torch.unflatten(self.products @ weights[..., None], 1, (2, 3, 3))[..., 0]
        C1, C2 = self.model.C1, self.model.C2
        first, second = (C @ S @ C.mT for C, S in zip((C1, C2), sums.unbind(1), strict=True))
        flat1, flat2 = (C[..., :2] @ C[..., :2].mT for C in (C1, C2))
        return _kron(first, flat2) + _kron(flat1, second)


def run_pose_stages(
    networks: nn.ModuleList,
    problem: LinearProblem,
    K1: Tensor,
    K2: Tensor,
    scores: Tensor | None,
    refine_steps: int,
    samples: int,
    detach_stages: bool,
) -> tuple[list[Calibrated], list[Tensor]]:
    """Return the states of the stages and their logits (B, N), for sets that determine their matrix."""
    present = problem.present
    frame = CommonFrame.from_points(problem.points1, problem.points2, present)
    x1, x2 = convert_points_to_homogeneous(torch.stack([frame.x1, frame.x2])).mT.contiguous()
    model = Essential.of_cameras(K1, K2, frame.T, frame.T)
    evidence = _Evidence.from_frame(model, frame, x1, x2)
    features = torch.cat([match_features(frame, scores, present), _rays(frame, evidence)], -1)
    states: list[Calibrated] = []
    found: list[Tensor] = []
    dtype, tiny = next(networks.parameters()).dtype, torch.finfo(problem.x1.dtype).tiny
    for number, network in enumerate(networks, 1):
        seen, factor = features, None
        if states:
            with torch.set_grad_enabled(torch.is_grad_enabled() and not detach_stages):
                F_mat = states[-1].matrix()
                residuals, _ = residual_features(model, x1, x2, F_mat, found[-1], present)
                squares, factor = (value[:, 0] for value in evidence.squares(states[-1].essential()[:, None]))
                pixels = evidence.unit * (squares + torch.finfo(squares.dtype).tiny).sqrt()
            seen = torch.cat([features, residuals, (pixels + PIXEL_FLOOR).log()[..., None] / 2], -1)
        logits, outputs = network(seen.to(dtype), None if present is None else present == 0)
        logits, outputs = logits.to(problem.x1), outputs.to(problem.x1)
        weights = logits.sigmoid()
        weights = weights / weights.detach().amax(1, keepdim=True) + MIN_WEIGHT
        weights = weights if problem.weights is None else weights * problem.weights
        scale = (SCALE_BOUND * torch.tanh(outputs / SCALE_BOUND)).exp()
        if number < len(networks):
            with torch.no_grad():
                axes = _axes(_likeliest(evidence, weights, factor, states[-1:]))
            axes = _reweight(evidence, axes, weights, weights, EARLY_SCALE * scale, EARLY_STEPS)
        else:
            with torch.no_grad():
                drawn = 0 if detach_stages else samples
                axes, front = _most_consistent(evidence, weights, factor, states[-1:], drawn)
            share = torch.where(front & (weights > 0), weights.clamp(min=tiny) ** LAST_POWER, 0.0)
            axes = _reweight(evidence, axes, share, weights, LAST_SCALE * scale, refine_steps)
        states.append(_state(axes, model))
        found.append(logits)
    return states, found


def _rays(frame: CommonFrame, evidence: _Evidence) -> Tensor:
    """Return the directions of both points and the frame's unit in pixels as features, (B, N, 5)."""
    rays = torch.unflatten(evidence.rays, 1, (2, 3))
    rays = torch.where(frame.swapped[:, None, None, None], rays.flip(1), rays)
    rays = rays[:, :, :2] / rays[:, :, 2:]
    unit = (evidence.unit / 100).log()[..., None].expand(-1, 1, rays.shape[-1])
    return torch.cat([rays.flatten(1, 2), unit], 1).mT


def _suggested(evidence: _Evidence, weights: Tensor, before: list[Calibrated]) -> tuple[Tensor, Tensor]:
    """Return the matrices of moments under weights (B, S, N) and of the stage before, and which of them are real."""
    E_mat, real = _span_moments(evidence, weights)
    if before:
        E_mat = torch.cat([E_mat, before[0].essential()[:, None]], 1)
        real = torch.cat([real, torch.ones_like(real[:, :1])], 1)
    return E_mat, real


def _likeliest(evidence: _Evidence, weights: Tensor, factor: Tensor | None, before: list[Calibrated]) -> Tensor:
    """Return the essential matrices (B, 3, 3) of least weighted cost among those that the weights suggest."""
    suggested = weights if factor is None else weights * factor
    E_mat, real = _suggested(evidence, suggested[:, None], before)
    losses = evidence.single().losses(E_mat.float(), EARLY_PIXELS)
    return _least(E_mat, real, losses, weights, 1)[:, 0]


def _most_consistent(
    evidence: _Evidence, weights: Tensor, factor: Tensor | None, before: list[Calibrated], samples: int
) -> tuple[Tensor, Tensor]:
    """Return the axes (B, 2, 3, 3) of least cost of all matches, whatever their weights, and which are in front.

    Candidates come from the moments with and without weights, and from minimal samples drawn by the weights. The best
    are fitted to all matches. A match behind a camera, (B, N) bool, costs as much as one far away.
    """
    single, present = evidence.single(), (weights > 0).to(weights)
    suggested = weights if factor is None else weights * factor
    E_mat, real = _suggested(evidence, torch.stack([suggested, present], 1), before)
    best = _least(E_mat, real, single.losses(E_mat.float(), LAST_PIXELS), present, 2)
    if samples:
        # Matches in the order of their weights: samples and choices don't depend on the order that they came in.
        order = weights.argsort(dim=1, descending=True, stable=True)
        drawn, real = _solve_samples(evidence, weights, order, samples)
        number = order.shape[1]
        some = order[:, torch.arange(min(number, MAX_SCORED), device=order.device) * number // min(number, MAX_SCORED)]
        losses = single.select(some).losses(drawn.float(), LAST_PIXELS)
        best = torch.cat([best, _least(drawn, real, losses, present.gather(1, some), SHORTLIST)], 1)
    count = best.shape[1]
    repeated, present = evidence.repeat(count), present.repeat_interleave(count, 0)
    scale, axes = (LAST_PIXELS / repeated.unit).square(), _axes(best.flatten(0, 1))
    front = repeated.in_front(_state(axes, repeated.model), present)
    axes = _descend(repeated, axes, present * front, lambda _: scale, LOCAL_STEPS)
    losses = torch.where(front, repeated.losses(_essential(axes)[:, None], LAST_PIXELS)[:, 0], 1.0)
    least = (losses * present).sum(1).view(-1, count).argmin(1)
    chosen = least + count * torch.arange(least.shape[0], device=least.device)
    return axes[chosen], front[chosen]


def _span_moments(evidence: _Evidence, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the matrices (B, 11 S, 3, 3) that moments under weights (B, S, N) suggest, and which of them are real."""
    basis = torch.linalg.eigh(evidence.moments(weights).flatten(0, 1))[1][..., :4].flip(-1).mT
    basis = torch.unflatten(basis, -1, (3, 3)).mT
    E_mat, real = essential_in_span(basis)
    nearest = nearest_essential(basis[:, 3])[:, None]
    E_mat, real = torch.cat([E_mat, nearest], 1), torch.cat([real, torch.ones_like(real[:, :1])], 1)
    number = 11 * weights.shape[1]
    return E_mat.view(-1, number, 3, 3), real.view(-1, number)


def _least(E_mat: Tensor, real: Tensor, losses: Tensor, weights: Tensor, number: int) -> Tensor:
    """Return the real matrices of least weighted sums of losses (B, S, N), (B, number, 3, 3)."""
    cost = (losses @ weights.to(losses)[..., None])[..., 0]
    cost = torch.where(real & cost.isfinite(), cost, torch.inf)
    best = cost.topk(min(number, cost.shape[1]), 1, largest=False).indices
    return E_mat.gather(1, best[..., None, None].expand(-1, -1, 3, 3))


def _solve_samples(evidence: _Evidence, weights: Tensor, order: Tensor, number: int) -> tuple[Tensor, Tensor]:
    """Return the matrices (B, 10 S, 3, 3) of minimal samples drawn by the weights, and which of them are real."""
    shares = weights.gather(1, order).cumsum(1)
    shares = shares / shares[:, -1:]
    steps = GOLDEN ** -torch.arange(1, 6, dtype=shares.dtype, device=shares.device)
    chances = (torch.arange(1, number + 1, device=shares.device)[:, None] * steps).frac().flatten()
    ranks = (shares[:, None, :-1] < chances[:, None]).sum(-1)
    rows = evidence.select(order.gather(1, ranks)).rows
    rows = torch.unflatten(rows, 2, (number, 5)).transpose(1, 2).flatten(0, 1)  # (B S, 9, 5)
    basis = torch.linalg.qr(rows, mode="complete")[0][..., 5:]
    E_mat, real = essential_in_span(torch.unflatten(basis.mT, -1, (3, 3)).mT)
    return E_mat.view(-1, 10 * number, 3, 3), real.view(-1, 10 * number)


def _reweight(evidence: _Evidence, axes: Tensor, weights: Tensor, inliers: Tensor, scale: Tensor, steps: int) -> Tensor:
    r"""Return axes after steps of reweighted least squares of the Sampson distances, differentiable.

    The loss is Geman and McClure's with a scale (B, 1) in geometric means of the distances, weighted by the
    probabilities of inliers, as in :func:`~kornia_learnnorm.estimators.optimize.refine_unrolled`.
    """
    share = inliers / inliers.sum(1, keepdim=True)
    effective = (1 / share.square().sum(1, keepdim=True)).clamp(min=6.0)
    scale = scale.square() * (effective / (effective - 5))
    floor = (PIXEL_FLOOR / evidence.unit).square()

    def square_scale(squares: Tensor) -> Tensor:
        return scale * (share * (squares + floor).log()).sum(1, keepdim=True).exp()

    return _descend(evidence, axes, weights, square_scale, steps)


def _descend(
    evidence: _Evidence, axes: Tensor, weights: Tensor, square_scale: Callable[[Tensor], Tensor], steps: int
) -> Tensor:
    r"""Return axes after Gauss-Newton steps, each on :math:`e^\top (M - X) e` of new weights.

    With squared distances :math:`(e^\top a_i)^2 / e^\top B_i e` and factors held, the moments
    :math:`M = \sum_i w_i a_i a_i^\top / e^\top B_i e` alone have another optimum:
    :math:`X = \sum_i w_i (e^\top a_i)^2 B_i / (e^\top B_i e)^2` is what the factors add to the gradient.
    ``square_scale`` gives the squared scale of Geman and McClure's loss, (B, 1), from the squared distances.

    Reference:
        W. Chojnacki, M. Brooks, A. van den Hengel, D. Gawley, On the fitting of surfaces to data with covariances,
        IEEE Transactions on Pattern Analysis and Machine Intelligence, 2000.

    """
    for _ in range(steps):
        squares, factor = (value[:, 0] for value in evidence.squares(_essential(axes)[:, None]))
        slope = UNROLLED_LOSS(squares / square_scale(squares))[1]
        share = weights * slope * factor
        M, X = evidence.moments(share[:, None])[:, 0], evidence.normal_moments(share * squares)
        axes = _gauss_newton(M, X, axes)
    return axes


def _axes(E_mat: Tensor) -> Tensor:
    """Return the axes (B, 2, 3, 3) of the nearest essential matrices."""
    U, _, Vh = torch.linalg.svd(E_mat)
    return torch.stack([U, Vh.mT], 1)


def _state(axes: Tensor, model: Essential) -> Calibrated:
    """Return the states of axes (B, 2, 3, 3) of both views."""
    return Calibrated(axes, _EQUAL.to(axes).expand(axes.shape[0], 2, 2), model.C1, model.C2)


def _essential(axes: Tensor) -> Tensor:
    """Return the essential matrices of axes (B, 2, 3, 3) of both views."""
    E_mat: Tensor = axes[:, 0, :, :2] @ axes[:, 1, :, :2].mT * 0.5**0.5
    return E_mat


def _gauss_newton(M: Tensor, X: Tensor, axes: Tensor) -> Tensor:
    """Return the axes after a step that lowers the cost of M - X (B, 9, 9), or unchanged."""
    trace = M.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    M, X = (value / (trace + (trace == 0)) for value in (M, X))
    U, V = axes.unbind(1)
    local = (V[:, :, None, :, None] * U[:, None, :, None, :]).view(-1, 9, 9) @ _LOCAL.to(M)
    tangents, e = local[..., :5], local[..., 5:]
    normal, gradient = tangents.mT @ M @ tangents, tangents.mT @ (M - X) @ e
    damping = DAMPING * normal.diagonal(dim1=-2, dim2=-1).mean(-1) + torch.finfo(M.dtype).tiny
    damped = normal + damping[:, None, None] * torch.eye(5, dtype=M.dtype, device=M.device)
    step = RELAXATION * torch.linalg.solve_ex(damped, gradient)[0][..., 0]
    S = torch.unflatten(step @ _SKEW.to(M), 1, (2, 3, 3))
    square = S @ S
    angle = square.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] / -2
    moved = axes - axes @ ((S - square / 2) / (1 + angle / 4))  # Cayley's map of the negative step
    new = _essential(moved).mT.flatten(1)[..., None]
    # A step at the optimum, whose derivative is the optimum's, may raise the cost by rounding.
    lower = new.mT @ (M - X) @ new <= e.mT @ (M - X) @ e + torch.finfo(M.dtype).eps
    return torch.where(lower[..., None], moved, axes)


def _kron(A: Tensor, B: Tensor) -> Tensor:
    """Return the Kronecker products (B, 9, 9) of matrices (B, 3, 3)."""
    return (A[:, :, None, :, None] * B[:, None, :, None, :]).flatten(3, 4).flatten(1, 2)


def _skew(*vector: float) -> Tensor:
    return cross_product_matrix(torch.tensor([vector], dtype=torch.float64))[0]


def _steps() -> tuple[Tensor, Tensor]:
    """Return the skew matrices (5, 18) of both views' axes for a step, and the derivatives of E and E itself, (9, 6).

    Two tilts of each view, and a turn of both against each other: swapping the views swaps the steps.
    """
    zero, unit = _skew(0, 0, 0), torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)) * 0.5**0.5
    x, y, turn = _skew(1, 0, 0), _skew(0, 1, 0), _skew(0, 0, 0.5)
    skews = [(x, zero), (y, zero), (zero, x), (zero, y), (turn, -turn)]
    columns = [*(S2 @ unit + unit @ S1.mT for S2, S1 in skews), unit]
    return torch.stack([torch.cat([*pair]).flatten() for pair in skews]), torch.stack(
        [column.mT.flatten() for column in columns], 1
    )


_SKEW, _LOCAL = _steps()
_EQUAL = torch.eye(2, dtype=torch.float64) * 0.5**0.5
