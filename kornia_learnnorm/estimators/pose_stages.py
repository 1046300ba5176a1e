r"""The stages of the learned relative pose: features, logits, moment matrix, essential matrices, robust steps."""

from typing import Any, NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.estimators.camera_evidence import contradict_cameras, keeps_fit
from kornia_learnnorm.estimators.moments import Evidence, SquareScale, descend, geometric_scale, least_cost, pick
from kornia_learnnorm.estimators.network_features import (
    CommonFrame,
    match_features,
    residual_features,
    upright_rotation,
)
from kornia_learnnorm.estimators.optimize import choose, differentiable_state
from kornia_learnnorm.estimators.stages import few_outliers
from kornia_learnnorm.estimators.weighted_samples import evenly_ranked, sample_null_spaces
from kornia_learnnorm.geometry.checks import is_known_true, safe_divisor
from kornia_learnnorm.geometry.dlt import row_moments, row_products
from kornia_learnnorm.geometry.five_point import essential_in_span
from kornia_learnnorm.geometry.matrices import determinant, unit_matrix
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.essential import Calibrated, Essential, nearest_essential
from kornia_learnnorm.models.fundamental import Fundamental

EARLY_STEPS, LOCAL_STEPS = 2, 3  # reweighting steps of early stages, and from candidates (twice if not settled)
# Scales of the robust loss in early stages and in the last one, in geometric means of the distances; the network
# predicts a factor on them.
EARLY_SCALE, LAST_SCALE = 3.0, 0.7
# Scales in evaluation, where means leave out distances beyond about NEAR means (networks learn slower), and if settled.
NEAR, EARLY_NEAR_SCALE, LAST_NEAR_SCALE, SETTLED_SCALE = 3.0, 4.2, 1.0, 4.4
SCALE_BOUND = 1.5  # the logarithm of the factor stays within plus and minus this
LAST_POWER = 0.1  # exponent of the probabilities in the last stage: nearly equal weights, as the loss rejects outliers
RELAXATION = 1.3  # factor on a step: a robust loss has less curvature than its weights imply
# With a mean focal length below MIN_FOCAL, points are normalised coordinates and count as pixels at NORMAL_FOCAL.
MIN_FOCAL, NORMAL_FOCAL = 10.0, 1000.0
MAX_RAY = 1e3  # bound on the ray features, which could overflow in the networks
EARLY_PIXELS, LAST_PIXELS = 2.0, 0.7  # scales of the losses that candidates are compared by
PIXEL_FLOOR = 1e-3  # pixels, added to distances before their logarithm
MIN_WEIGHT = 1e-6  # added to weights that are scaled to a maximum of one
MAX_SCORED = 256  # matches on which the matrices of minimal samples are pre-scored
SHORTLIST = 6  # best matrices of minimal samples, which are then compared on all matches
# Below this share of inliers, samples are drawn again from the matches within NEAR_PIXELS of the best matrix, if there
# are at least MIN_NEAR.
FEW_INLIERS, NEAR_PIXELS, MIN_NEAR = 0.4, 14.0, 16

Candidates = tuple[Tensor, Tensor]  # essential matrices (B, S, 3, 3), and which of them are real


def run_pose_stages(
    layer: Any, problem: LinearProblem, K1: Tensor, K2: Tensor, scores: Tensor | None
) -> tuple[list[Calibrated], list[Tensor]]:
    """Return the states of the stages and their logits (B, N), for sets that determine their matrix.

    In evaluation, sets with few outliers skip the stages between the first network and the last fit.
    """
    networks, detach_stages, present = layer.networks, layer.detach_stages, problem.present
    settle = layer.samples > 0 and not (layer.training or detach_stages)
    frame = CommonFrame.from_points(problem.points1, problem.points2, present)
    x1, x2 = convert_points_to_homogeneous(torch.stack([frame.x1, frame.x2])).mT.contiguous()
    model = Essential.of_cameras(K1, K2, frame.T, frame.T)
    evidence, unit = Evidence.from_points(x1, x2), frame.inverse[:, 0, 0, None] * _pixels_per_unit(K1, K2)
    matches = _Matches(evidence, model, unit)
    upright = upright_rotation(frame, present)
    rays = _rays(frame, upright, model, x1, x2, unit)
    features = torch.cat([match_features(frame, upright, scores, present), rays], -1)
    states: list[Calibrated] = []
    found: list[Tensor] = []
    settled = torch.zeros_like(problem.x1[:, 0, 0], dtype=torch.bool)
    dtype = networks[0].stem.weight.dtype
    near, early, last = (NEAR, EARLY_NEAR_SCALE, LAST_NEAR_SCALE) if settle else (None, EARLY_SCALE, LAST_SCALE)
    for network in networks:
        seen, factor, before = features, None, None
        if states:
            with torch.set_grad_enabled(torch.is_grad_enabled() and not detach_stages):
                F_mat = states[-1].matrix()
                residuals, _ = residual_features(model, x1, x2, F_mat, found[-1], present)
                squares, factor = (value[:, 0] for value in evidence.squares(F_mat[:, None]))
                pixels = unit * (squares + torch.finfo(squares.dtype).tiny).sqrt()
            seen = torch.cat([features, residuals, (pixels + PIXEL_FLOOR).log()[..., None] / 2], -1)
            factor = torch.where(settled[:, None], 1.0, factor)
            before = states[-1].essential()[:, None], ~settled[:, None]
        logits, outputs = network(seen.to(dtype), None if present is None else present == 0)
        logits, outputs = logits.to(problem.x1), outputs.to(problem.x1)
        if states:
            logits = torch.where(settled[:, None], found[-1], logits)
        scale = (SCALE_BOUND * torch.tanh(outputs / SCALE_BOUND)).exp()
        if settle and not states:
            settled = few_outliers(logits, None if problem.weights is None else problem.weights > 0)
        weights = logits.sigmoid()
        weights = weights / weights.detach().amax(1, keepdim=True) + MIN_WEIGHT
        power = weights**LAST_POWER
        if problem.weights is not None:  # only their ratios matter, not their size
            given = problem.weights / safe_divisor(problem.weights.detach().amax(1, keepdim=True))
            weights, power = weights * given, power * given
        suggested = weights if factor is None else weights * factor
        found.append(logits)
        if len(found) == len(networks) or (is_known_true(settled.all()) and len(settled) > 0):
            break
        with torch.no_grad():  # the candidates with the least weighted cost
            spans = matches.moment_spans(suggested[:, None])
            E_mat, real = _suggested(spans, _in_spans(spans), before)
            losses = matches.losses(E_mat, EARLY_PIXELS / unit)
            state = model.calibrated(least_cost(E_mat, real, losses, weights, 1)[:, 0])
        state = model.attach(state)
        square_scale = matches.square_scale(weights, early * scale, near)
        states.append(descend(evidence, state, weights[:, None], square_scale, EARLY_STEPS, RELAXATION))
    drawn = 0 if detach_stages else layer.samples
    with torch.no_grad():
        state, front = matches.most_consistent(weights, suggested, before, drawn, settled)
        state, front = matches.search_near(weights, state, front, drawn, settled)
    state = model.attach(state)
    share = torch.where(front, power, 0.0)
    scale = torch.where(settled[:, None], SETTLED_SCALE, last * scale)
    options = matches.square_scale(weights, scale, near), layer.refine_steps
    state = descend(evidence, state, share[:, None], *options, RELAXATION)
    if not detach_stages:
        state = matches.leave_cameras(state, share, *options)
    # A settled set has gone to the last stage at once.
    states = [choose(settled, state, other) for other in states]
    return states + (len(networks) - len(states)) * [state], found + (len(networks) - len(found)) * found[-1:]


class _Matches(NamedTuple):
    """Correspondences in the common frame, with their cameras."""

    evidence: Evidence
    model: Essential
    unit: Tensor  # of the frame, pixels, (B, 1)

    def losses(self, E_mat: Tensor, scale: Tensor) -> Tensor:
        """Return the losses of essential matrices (B, S, 3, 3) in float32, of a scale in the frame's unit (B, 1)."""
        F_mat = self.model.C2.mT[:, None] @ E_mat @ self.model.C1[:, None]
        return self.evidence.single().losses(F_mat.float(), scale.square()[:, None])

    def square_scale(self, inliers: Tensor, scale: Tensor, near: float | None) -> SquareScale:
        """Return the function from squared distances (B, S, N) to the squared scale (B, S, 1) of the loss.

        The scale (B, 1) is in geometric means of the distances, weighted by the probabilities of inliers.
        """
        mean = geometric_scale(inliers, Essential.dof, (PIXEL_FLOOR / self.unit).square()[:, None], near)
        return lambda squares: scale.square()[:, None] * mean(squares)

    def moment_spans(self, weights: Tensor) -> Tensor:
        """Return the four smallest eigenvectors (B, S, 4, 3, 3) of moments with weights (B, S, N), smallest last."""
        carry = torch.einsum("bik,bjl->bklij", self.model.C1, self.model.C2)  # of the entries of E to those of F
        carry = carry.flatten(3, 4).flatten(1, 2)[:, None]
        M = row_moments(weights, row_products(self.evidence.products))
        basis = torch.linalg.eigh(carry.mT @ M @ carry)[1][..., :4].flip(-1).mT
        return torch.unflatten(basis, -1, (3, 3)).mT

    def most_consistent(
        self, weights: Tensor, suggested: Tensor, before: Candidates | None, samples: int, settled: Tensor
    ) -> tuple[Calibrated, Tensor]:
        """Return the states with the least unweighted cost over all matches, and which matches are in front, (B, N).

        Candidates come from the moments with and without weights, and from minimal samples drawn by the weights. The
        best are fitted to all matches. A match behind a camera costs as much as one far away.
        """
        (evidence, model, unit), present = self, (weights > 0).to(weights)
        # Sort the matches by weight, so that samples and choices do not depend on the order of the input.
        order = weights.argsort(dim=1, descending=True, stable=True)
        scale = LAST_PIXELS / unit
        few = (samples + 1) // 2  # samples are enough for a settled set
        samples = few if is_known_true(settled.all()) else samples
        drawn, used = sample_null_spaces(evidence, weights, order, samples, Essential.sample_size)
        inverse1, inverse2 = (torch.linalg.inv_ex(C)[0][:, None, None] for C in (model.C1, model.C2))
        drawn = inverse2.mT @ drawn @ inverse1
        used = used & (~settled[:, None] | (torch.arange(samples, device=settled.device) < few))
        spans = self.moment_spans(torch.stack([suggested, present], 1))
        found, real = _in_spans(torch.cat([spans, drawn], 1))
        number = 10 * spans.shape[1]
        E_mat, drawn = found[:, :number], found[:, number:]
        E_mat, own_real = _suggested(spans, (E_mat, real[:, :number]), before)
        E_mat = least_cost(E_mat, own_real, self.losses(E_mat, scale), present, 2)
        real = real[:, number:] & used.repeat_interleave(10, 1)
        half = 5 * samples  # of the candidates
        if is_known_true((real.sum(1) <= half).all()):  # usually true; the other half is then not scored
            first = real.argsort(dim=1, descending=True, stable=True)[:, :half]
            drawn, real = drawn.gather(1, first[..., None, None].expand(-1, -1, 3, 3)), real.gather(1, first)
        some = evenly_ranked(order, present, MAX_SCORED)
        losses = self._replace(evidence=evidence.select(some)).losses(drawn, scale)
        E_mat = torch.cat([E_mat, least_cost(drawn, real, losses, present.gather(1, some), SHORTLIST)], 1)
        number = E_mat.shape[1]
        repeated = Essential(model.C1.repeat_interleave(number, 0), model.C2.repeat_interleave(number, 0))
        state, square = repeated.calibrated(E_mat.flatten(0, 1)), scale.square()[:, None]
        front = evidence.in_front(state, present[:, None], number)
        options = present[:, None] * front, lambda _: square, LOCAL_STEPS, RELAXATION
        state = descend(evidence, state, *options)
        if not is_known_true(settled.all()):
            state = choose(settled.repeat_interleave(number, 0), state, descend(evidence, state, *options))
        losses = evidence.losses(torch.unflatten(state.matrix(), 0, (-1, number)), square)
        best = (torch.where(front, losses, 1.0) @ present[..., None])[..., 0].argmin(1)
        return pick(state, best, number), front.gather(1, best[:, None, None].expand(-1, 1, front.shape[-1]))[:, 0]

    def search_near(
        self, weights: Tensor, state: Calibrated, front: Tensor, samples: int, settled: Tensor
    ) -> tuple[Calibrated, Tensor]:
        """Return the states; where few matches agree with them, search again among the matches near them."""
        if not samples or is_known_true(settled.all()):
            return state, front
        pixels = self.evidence.squares(state.matrix()[:, None])[0][:, 0].sqrt() * self.unit
        near = torch.where(pixels < NEAR_PIXELS, weights, 0.0)
        again = ((pixels < LAST_PIXELS) & front).sum(1) < FEW_INLIERS * (weights > 0).sum(1)
        again = again & ((near > 0).sum(1) >= MIN_NEAR) & ~settled
        if is_known_true(~again.any()):
            return state, front
        best = state.essential()[:, None], torch.ones_like(again)[:, None]
        found, found_front = self.most_consistent(near, near, best, samples, settled)
        return choose(again, found, state), torch.where(again[:, None], found_front, front)

    def leave_cameras(self, state: Calibrated, weights: Tensor, square_scale: SquareScale, steps: int) -> Calibrated:
        """Return the states, or poses of fundamental matrices where the correspondences contradict the cameras."""
        evidence, model, unit = self
        with torch.no_grad():
            square = square_scale(evidence.squares(state.matrix()[:, None])[0])[:, 0]
            left = contradict_cameras(evidence, state, weights, square)
        if is_known_true(~left.any()):
            return state
        with torch.no_grad():
            start = Fundamental().state(state.matrix())
        free = descend(evidence, start, weights[:, None], square_scale, steps, RELAXATION)
        # As a matrix of viewing directions, it has derivatives with respect to the cameras, and unit norm.
        eye = Essential(torch.eye(3).to(model.C1)[None], torch.eye(3).to(model.C2)[None])
        inverse1, inverse2 = (torch.linalg.inv_ex(C)[0] for C in (model.C1, model.C2))
        nearest = model.attach(differentiable_state(eye, unit_matrix(inverse2.mT @ free.matrix() @ inverse1)))
        wide = square.maximum((EARLY_PIXELS / unit).square())
        kept: Calibrated = choose(left & keeps_fit(evidence, state, nearest, weights, wide), nearest, state)
        return kept


def _pixels_per_unit(K1: Tensor, K2: Tensor) -> Tensor:
    """Return the pixels per unit of the points, (B, 1): one, except for normalised coordinates."""
    K = torch.stack([K1, K2]).detach()
    focal = (determinant(K).abs() / K[..., 2, 2] ** 3).sqrt().mean(0)[:, None]  # geometric mean along the axes
    return torch.where(focal < MIN_FOCAL, NORMAL_FOCAL / focal, 1.0)


def _rays(frame: CommonFrame, upright: Tensor, model: Essential, x1: Tensor, x2: Tensor, unit: Tensor) -> Tensor:
    """Return the directions of both points and the frame's unit in pixels as features, (B, N, 5)."""
    rays = torch.stack([model.C1 @ x1, model.C2 @ x2], 1)
    first, second = torch.where(frame.swapped[:, None, None, None], rays.flip(1), rays).unbind(1)
    rays = torch.stack([first, upright @ second], 1)
    rays = (rays[:, :, :2] / rays[:, :, 2:]).clamp(-MAX_RAY, MAX_RAY)
    return torch.cat([rays.flatten(1, 2), (unit[..., None] / 100).log().expand(-1, 1, rays.shape[-1])], 1).mT


def _in_spans(spans: Tensor) -> Candidates:
    """Return the essential matrices in spans of four matrices (B, S, 4, 3, 3), (B, 10 S, 3, 3)."""
    E_mat, real = essential_in_span(spans.flatten(0, 1))
    E_mat, real = (torch.unflatten(value, 0, spans.shape[:2]).flatten(1, 2) for value in (E_mat, real))
    return E_mat, real


def _suggested(spans: Tensor, found: Candidates, before: Candidates | None) -> Candidates:
    """Return the matrices found in spans, the nearest ones to the smallest eigenvectors, and the previous stage's."""
    nearest = nearest_essential(spans[:, :, 3].flatten(0, 1)).view_as(spans[:, :, 3])
    candidates = [found, (nearest, torch.ones_like(nearest[..., 0, 0], dtype=torch.bool))]
    candidates += [] if before is None else [before]
    E_mat, real = (torch.cat(values, 1) for values in zip(*candidates, strict=True))
    return E_mat, real
