r"""The stages of the learned relative pose: features, logits, moment matrix, essential matrices, robust steps.

Correspondences enter the solution through the :math:`9 \times 9` matrix of the second moments of their design rows
alone, :math:`\sum_i w_i a_i a_i^\top`: what follows costs the same for ten matches and for thousands.
"""

from __future__ import annotations

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
from kornia_learnnorm.geometry.five_point import essential_in_span
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.essential import Calibrated, Essential

__all__ = ["POSE_OUTPUTS", "POSE_POINT_FEATURES", "POSE_RESIDUAL_FEATURES", "run_pose_stages"]

POSE_POINT_FEATURES, POSE_RESIDUAL_FEATURES = POINT_FEATURES + 5, RESIDUAL_FEATURES + 1
POSE_OUTPUTS = 1  # of a stage's network for the whole set: the logarithm of the robust scale's factor
EARLY_STEPS = 2  # largest number of reweightings in all stages but the last
INNER_STEPS = 2  # Gauss-Newton steps between two reweightings
SCALE = 3.0  # of the robust loss over the geometric mean of the distances, times the network's factor
SCALE_BOUND = 1.5  # the logarithm of the factor stays within plus and minus this
WEIGHTED_PIXELS, FINAL_PIXELS = 2.0, 1.0  # scales of the losses that candidates are compared by
PIXEL_FLOOR = 1e-3  # pixels, added to distances before their logarithm
NORMAL_FLOOR = 1e-4  # of the root mean square norm of the lines' normals, added to each
MIN_WEIGHT = 1e-6  # added to weights of which the largest is one
DAMPING = 1e-9  # of the mean diagonal of the normal matrix, added to it
GOLDEN = 1.1347241384015194  # root of x^6 = x + 1: multiples of its powers spread evenly (M. Roberts, 2018)
MAX_SCORED = 256  # matches by which the matrices of minimal samples are compared


class _Evidence(NamedTuple):
    """Correspondences of calibrated views, and what their distances under essential matrices need."""

    model: Essential  # in the frame
    x1: Tensor  # homogeneous points in the frame, (B, 3, N)
    x2: Tensor
    rows: Tensor  # of the design matrix of directions, for the column-major entries of E, (B, 9, N)
    unit: Tensor  # of the frame, in pixels, (B, 1)

    @classmethod
    def from_frame(cls, frame: CommonFrame, K1: Tensor, K2: Tensor) -> _Evidence:
        x1, x2 = convert_points_to_homogeneous(torch.stack([frame.x1, frame.x2])).mT.contiguous()
        model = Essential.of_cameras(K1, K2, frame.T, frame.T)
        rows = ((model.C1 @ x1)[:, :, None] * (model.C2 @ x2)[:, None]).flatten(1, 2)
        return cls(model, x1, x2, rows, frame.inverse[:, 0, 0, None])

    def select(self, index: Tensor) -> _Evidence:
        """Return the correspondences of given indices (B, M)."""
        x1, x2, rows = (values.gather(2, index[:, None].expand(-1, values.shape[1], -1)) for values in self[1:4])
        return _Evidence(self.model, x1, x2, rows, self.unit)

    def squares(self, E_mat: Tensor) -> tuple[Tensor, Tensor]:
        """Return squared Sampson distances under matrices (B, S, 3, 3) and gradient factors, each (B, S, N).

        Distances are in the frame's unit; the factors turn squared algebraic residuals into their squares.
        """
        F_mat = self.model.C2.mT[:, None] @ E_mat @ self.model.C1[:, None]
        number = E_mat.shape[1]
        line2 = torch.unflatten(F_mat[:, :, :2].flatten(1, 2) @ self.x1, 1, (number, 2))
        line1 = torch.unflatten(F_mat.mT[:, :, :2].flatten(1, 2) @ self.x2, 1, (number, 2))
        norms = line2.square().sum(2) + line1.square().sum(2)
        norms = norms + NORMAL_FLOOR**2 * norms.mean(-1, keepdim=True) + torch.finfo(norms.dtype).tiny
        algebraic = E_mat.mT.flatten(2) @ self.rows
        factor = 1 / norms
        return algebraic.square() * factor, factor

    def cost(self, E_mat: Tensor, weights: Tensor, pixels: float) -> Tensor:
        """Return the weighted sums (B, S) of Geman and McClure's loss of a scale in pixels.

        A match on the other side of its epipole than most counts as one far from its line (O. Chum, T. Werner,
        J. Matas, Epipolar geometry estimation via RANSAC benefits from the oriented epipolar constraint, ICPR 2004).
        """
        relative = self.squares(E_mat)[0] * (self.unit[:, None] / pixels).square()
        first, second, third = E_mat.unbind(-1)
        crossed = torch.stack([torch.linalg.cross(a, b) for a, b in ((first, second), (second, third), (third, first))])
        largest = crossed.square().sum(-1).argmax(0)[None, ..., None].expand(1, *first.shape)
        oriented = cross_product_matrix(crossed.gather(0, largest)[0]).mT @ E_mat
        side = (oriented.mT.flatten(2) @ self.rows).sign()
        wrong = side * (side * weights[:, None]).sum(-1, keepdim=True) < 0
        return (torch.where(wrong, 1.0, relative / (1 + relative)) * weights[:, None]).sum(-1)

    def moments(self, weights: Tensor) -> Tensor:
        """Return the second moments of the design rows, (B, 9, 9), of trace one."""
        M = (self.rows * weights[:, None]) @ self.rows.mT
        trace = M.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        return M / (trace + (trace == 0))


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
    evidence = _Evidence.from_frame(frame, K1, K2)
    features = torch.cat([match_features(frame, scores, present), _rays(frame, evidence)], -1)
    states: list[Calibrated] = []
    found: list[Tensor] = []
    dtype = next(networks.parameters()).dtype
    for number, network in enumerate(networks, 1):
        seen, factor = features, None
        if states:
            with torch.set_grad_enabled(torch.is_grad_enabled() and not detach_stages):
                F_mat = states[-1].matrix()
                residuals, _ = residual_features(evidence.model, evidence.x1, evidence.x2, F_mat, found[-1], present)
                squares, factor = (value[:, 0] for value in evidence.squares(states[-1].essential()[:, None]))
                pixels = evidence.unit * (squares + torch.finfo(squares.dtype).tiny).sqrt()
            seen = torch.cat([features, residuals, (pixels + PIXEL_FLOOR).log()[..., None] / 2], -1)
        logits, outputs = network(seen.to(dtype), None if present is None else present == 0)
        logits, outputs = logits.to(problem.x1), outputs.to(problem.x1)
        weights = logits.sigmoid()
        weights = weights / weights.detach().amax(1, keepdim=True) + MIN_WEIGHT
        weights = weights if problem.weights is None else weights * problem.weights
        last = number == len(networks)
        with torch.no_grad():
            E_mat = _best_candidate(
                evidence, weights, factor, states[-1:], samples if last and not detach_stages else 0
            )
            state = evidence.model.calibrated(E_mat)
        factor = (SCALE_BOUND * torch.tanh(outputs / SCALE_BOUND)).exp()
        states.append(_reweight(evidence, state, weights, SCALE * factor, refine_steps if last else EARLY_STEPS))
        found.append(logits)
    return states, found


def _rays(frame: CommonFrame, evidence: _Evidence) -> Tensor:
    """Return the directions of both points and the frame's unit in pixels as features, (B, N, 5)."""
    rays = torch.stack([evidence.model.C1 @ evidence.x1, evidence.model.C2 @ evidence.x2], 1)
    rays = torch.where(frame.swapped[:, None, None, None], rays.flip(1), rays)
    rays = rays[:, :, :2] / rays[:, :, 2:]
    unit = (evidence.unit / 100).log()[..., None].expand(-1, 1, rays.shape[-1])
    return torch.cat([rays.flatten(1, 2), unit], 1).mT


def _best_candidate(
    evidence: _Evidence, weights: Tensor, factor: Tensor | None, before: list[Calibrated], samples: int
) -> Tensor:
    """Return the essential matrices (B, 3, 3) of least robust cost among those that the weights suggest."""
    E_mat, real = _span_moments(evidence, weights if factor is None else weights * factor)
    if before:
        E_mat = torch.cat([E_mat, torch.stack([state.essential() for state in before], 1)], 1)
        real = torch.cat([real, real.new_ones(len(real), len(before))], 1)
    if not samples:
        return _least(evidence, E_mat, real, weights, WEIGHTED_PIXELS)[:, 0]
    # Matches in the order of their weights: samples and choices then don't depend on the order that they came in.
    order = weights.argsort(dim=1, descending=True, stable=True)
    present = (weights > 0).to(weights)
    drawn, drawn_real = _solve_samples(evidence, weights, order, samples)
    number = order.shape[1]
    some = order[:, torch.arange(min(number, MAX_SCORED), device=order.device) * number // min(number, MAX_SCORED)]
    drawn = _least(evidence.select(some), drawn, drawn_real, present.gather(1, some), FINAL_PIXELS, 4)
    plain, plain_real = _span_moments(evidence, present)
    E_mat = torch.cat([E_mat, drawn, plain], 1)
    real = torch.cat([real, real.new_ones(drawn.shape[:2]), plain_real], 1)
    return _least(evidence, E_mat, real, present, FINAL_PIXELS)[:, 0]


def _span_moments(evidence: _Evidence, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the essential matrices (B, 11, 3, 3) that a matrix of moments suggests, and which of them are real."""
    basis = torch.linalg.eigh(evidence.moments(weights))[1][..., :4].flip(-1).mT
    basis = torch.unflatten(basis, -1, (3, 3)).mT
    E_mat, real = essential_in_span(basis)
    nearest = evidence.model.calibrated(basis[:, 3]).essential()[:, None]
    return torch.cat([E_mat, nearest], 1), torch.cat([real, real.new_ones(len(real), 1)], 1)


def _least(evidence: _Evidence, E_mat: Tensor, real: Tensor, weights: Tensor, pixels: float, number: int = 1) -> Tensor:
    """Return the real matrices of least cost, (B, number, 3, 3)."""
    cost = torch.where(real, evidence.cost(E_mat, weights, pixels), torch.inf)
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
    return torch.unflatten(E_mat.flatten(0, 1), 0, (-1, 10 * number)), torch.unflatten(
        real.flatten(), 0, (-1, 10 * number)
    )


def _reweight(evidence: _Evidence, state: Calibrated, weights: Tensor, scale: Tensor, steps: int) -> Calibrated:
    r"""Return states after steps of reweighted least squares of the Sampson distances, differentiable.

    The loss is Geman and McClure's with a scale (B, 1) in weighted geometric means of the distances, as in
    :func:`~kornia_learnnorm.estimators.optimize.refine_unrolled`. Between two reweightings the weights and the gradient
    factors are held, and Gauss-Newton steps on the manifold minimise :math:`e^\top M e`.
    """
    share = weights / weights.sum(1, keepdim=True)
    effective = (1 / share.square().sum(1, keepdim=True)).clamp(min=6.0)
    scale = scale * (effective / (effective - 5)).sqrt()
    for _ in range(steps):
        squares, factor = (value[:, 0] for value in evidence.squares(state.essential()[:, None]))
        floor = (PIXEL_FLOOR / evidence.unit).square()
        mean = (share * (squares + floor).log()).sum(1, keepdim=True).exp()
        slope = (1 + squares / (scale.square() * mean)).square().reciprocal()
        M = evidence.moments(share * slope * factor)
        for _ in range(INNER_STEPS):
            state = _gauss_newton(M, state)
    return state


def _gauss_newton(M: Tensor, state: Calibrated) -> Calibrated:
    """Return the states after a step that lowers the algebraic cost of moments (B, 9, 9), or unchanged."""
    e, D = state.essential().mT.flatten(1)[..., None], state.essential_tangents()
    DM = D.mT @ M
    normal, gradient = DM @ D, (DM @ e)[..., 0]
    damping = DAMPING * normal.diagonal(dim1=-2, dim2=-1).mean(-1) + torch.finfo(M.dtype).tiny
    eye = torch.eye(5, dtype=M.dtype, device=M.device)
    moved = state.retract(-torch.linalg.solve_ex(normal + damping[:, None, None] * eye, gradient)[0])
    e_new = moved.essential().mT.flatten(1)[..., None]
    # A step at the optimum, whose derivative is the optimum's, may raise the cost by rounding.
    better = ((e_new.mT @ M @ e_new) <= (e.mT @ M @ e) + torch.finfo(M.dtype).eps)[:, 0]
    axes = torch.where(better[..., None, None], moved.axes, state.axes)
    return moved._replace(axes=axes, A=torch.where(better[..., None], moved.A, state.A))
