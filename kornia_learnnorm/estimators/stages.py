"""The stages of a learned layer: network, weighted DLT, and the refinement that the next stage starts from."""

from typing import Any

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.estimators.linear import solve_in_coordinates
from kornia_learnnorm.estimators.network_features import (
    CommonFrame,
    match_features,
    residual_features,
    upright_rotation,
)
from kornia_learnnorm.estimators.optimize import refine_unrolled
from kornia_learnnorm.geometry.checks import is_known_true, weighted_mean
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import spd_transform
from kornia_learnnorm.models.two_view_model import TwoViewModel

EARLY_STEPS = 3  # largest number of refinement steps in all stages but the last
MAX_MINIMAL_DISTANCE = 0.01  # frame units; largest RMS distance that the best fit of `min_points` inliers leaves
MIN_WEIGHT = 1e-6  # added to weights that are scaled to a maximum of one
BOUND = 2.0  # the parameters of the transforms stay within plus and minus this
MIN_SETTLED, SETTLED = 16, 0.7  # matches, and mean probability, from which the first stage is enough
TRANSFORM_PARAMS = 5  # of each view's SPD transform
MAX_SETS_ON_GPU = 2000  # searched at once: PyTorch cannot decompose the matrices of 65,536 samples with CUDA
MAX_MATCHES = 8192  # processed at once on a CPU: their features fit into its cache


def run_stages(layer: Any, problem: LinearProblem, scores: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return matrices (B, S, 3, 3) and logits (B, S, N) of the stages, for sets that determine their matrix.

    Unless stages are detached, the refined matrices of the last stage follow. Sets that are settled after the first
    stage keep its result in the others. All is computed in the common frame; the results are in pixels.
    """
    model, present, detach_stages = layer.model, problem.present, layer.detach_stages
    frame = CommonFrame.from_points(problem.points1, problem.points2, present)
    upright, factor = upright_rotation(frame, present), None
    features = match_features(frame, upright, scores, present)
    found: list[tuple[Tensor, Tensor]] = []
    with torch.set_grad_enabled(torch.is_grad_enabled() and not detach_stages):
        refine: Refinement = layer.refinement(model, problem, frame, layer.samples, not layer.training)
    dtype = layer.networks[0].stem.weight.dtype  # replicas of nn.DataParallel have no parameters
    settled: Tensor | None = None
    for network in layer.networks:
        if refine.all_settled:
            found.append(found[0])
            continue
        seen = features
        if found:
            with torch.set_grad_enabled(torch.is_grad_enabled() and not detach_stages):
                before = refine(*found[-1], min(EARLY_STEPS, layer.refine_steps))
                residuals, factor = residual_features(model, refine.x1, refine.x2, *before, present)
            seen = torch.cat([features, residuals], -1)
        logits, params = network(seen.to(dtype), None if present is None else present == 0)
        logits, params = logits.to(problem.x1), params.to(problem.x1)
        weights = logits.sigmoid() if factor is None else logits.sigmoid() * factor
        weights = weights if problem.weights is None else weights * problem.weights
        M = _solve_weighted(model, frame, upright, weights, present, params if layer.learn_transforms else None)
        if settled is not None:
            M = torch.where(settled[:, None, None], found[0][0], M)
            logits = torch.where(settled[:, None], found[0][1], logits)
        found.append((M, logits))
        if len(found) == 1 and not detach_stages:
            settled = refine.settled(logits)
    if not detach_stages:
        found.append(refine(*found[-1], layer.refine_steps, last=True))
    matrices, all_logits = zip(*found, strict=True)
    T = frame.T[:, None]
    return unit_matrix(model.carry(torch.stack(matrices, 1), T, T)), torch.stack(all_logits, 1)


def in_pieces(problem: LinearProblem, *values: Tensor | None) -> list[tuple[Any, ...]]:
    """Return a problem and values of its sets in pieces of a size that suits the device; in one for CPU gradients."""
    number, on_cpu = problem.x1.shape[0], problem.x1.device.type == "cpu"
    size = max(1, MAX_MATCHES // max(1, problem.x1.shape[1])) if on_cpu else MAX_SETS_ON_GPU
    if torch.compiler.is_compiling() or (on_cpu and torch.is_grad_enabled()) or number <= size:
        return [(problem, *values)]
    pieces = [slice(start, start + size) for start in range(0, number, size)]
    return [(problem.select(rows), *[None if v is None else v[rows] for v in values]) for rows in pieces]


def _solve_weighted(
    model: TwoViewModel,
    frame: CommonFrame,
    upright: Tensor,
    weights: Tensor,
    present: Tensor | None,
    params: Tensor | None,
) -> Tensor:
    """Return the matrices of the weighted DLT with the predicted transforms, or Hartley's, in the frame."""
    weights = weights / weights.amax(1, keepdim=True)
    weights = weights + (MIN_WEIGHT if present is None else MIN_WEIGHT * present)
    weighted = LinearProblem.from_points(frame.x1, frame.x2, weights, model)
    if params is None:
        return solve_in_coordinates(weighted, weighted.T1, weighted.T2)
    params = torch.unflatten(BOUND * torch.tanh(params / BOUND), -1, (2, TRANSFORM_PARAMS))
    swapped, own = frame.swapped[:, None, None, None], torch.stack([weighted.T1, weighted.T2], 1)
    first, second = torch.where(swapped, own.flip(1), own).unbind(1)
    T = spd_transform(params) @ torch.stack([first, upright @ second], 1)
    T1, T2 = torch.where(swapped, T.flip(1), T).unbind(1)
    return solve_in_coordinates(weighted, T1, T2)


def few_outliers(logits: Tensor, present: Tensor | None) -> Tensor:
    """Return which sets of enough correspondences have few outliers by their logits (B, N), (B,) bool."""
    present = torch.ones_like(logits) if present is None else present.to(logits)
    number = present.sum(1)
    return (number >= MIN_SETTLED) & ((logits.sigmoid() * present).sum(1) > SETTLED * number)


class Refinement:
    """Robust refinement of a stage's matrices in the common frame; sets of ``min_points`` matches are solved once.

    With ``settle``, sets with few outliers skip stages: the ``samples`` of the last stage find as good a matrix.
    """

    min_searched = 0  # matches of the smallest set that is searched

    def __init__(
        self, model: TwoViewModel, problem: LinearProblem, frame: CommonFrame, samples: int = 0, settle: bool = False
    ) -> None:
        self.model, self.weights = model, problem.weights
        self.x1, self.x2 = convert_points_to_homogeneous(torch.stack([frame.x1, frame.x2])).mT.contiguous()
        # A traced program serves sets of any size.
        searched = torch.compiler.is_compiling() or self.x1.shape[-1] >= self.min_searched
        self.samples, self.settle = samples if searched else 0, settle
        self.few_outliers: Tensor | None = None
        self.all_settled = False
        can_be_minimal = problem.weights is not None or problem.x1.shape[1] <= model.min_points
        self.minimal = _solve_minimal(model, problem, frame, self.x1, self.x2) if can_be_minimal else None

    def __call__(self, M: Tensor, logits: Tensor, steps: int, last: bool = False) -> tuple[Tensor, Tensor]:
        """Return a stage's matrices after ``steps`` steps, and its logits."""
        if self.minimal is not None and self.x1.shape[-1] == self.model.min_points:
            # The stage has no effect; adding zero times M gives its network, scores and weights a gradient of zero.
            return self.minimal + 0.0 * M, logits
        refined = self.optimize(M, logits.sigmoid(), steps, last)
        if self.minimal is not None and self.weights is not None:
            is_minimal = ((self.weights > 0).sum(1) <= self.model.min_points)[:, None, None]
            refined = torch.where(is_minimal, self.minimal, refined)
        return refined, logits

    def settled(self, logits: Tensor) -> Tensor | None:
        """Return which sets need no stage but the first and its refinement, (B,) bool; None if all stages are run."""
        if self.settle and self.samples:
            self.few_outliers = few_outliers(logits, None if self.weights is None else self.weights > 0)
            # Without determined sets all stages are run, so that every network gets a gradient (of zero).
            self.all_settled = is_known_true(self.few_outliers.all()) and len(self.few_outliers) > 0
        return self.few_outliers

    def optimize(self, M: Tensor, probability: Tensor, steps: int, last: bool) -> Tensor:
        """Return the matrices after ``steps`` steps, weighted by inlier probability; ``last`` in the last stage."""
        weights = probability if self.weights is None else probability * self.weights
        return refine_unrolled(self.model, self.x1, self.x2, M, weights, steps)


def _solve_minimal(model: TwoViewModel, problem: LinearProblem, frame: CommonFrame, x1: Tensor, x2: Tensor) -> Tensor:
    """Return the matrices, in the frame, of ``min_points`` matches; by projection where the best ones don't fit.

    A best fit that leaves large distances is a fit to outliers. There the optimum of the first-order distances is, on
    average, worse than the projection in Hartley's coordinates.
    """
    T1, T2 = problem.T1 @ frame.inverse, problem.T2 @ frame.inverse
    best = model.carry(model.solve_minimal(problem), T1, T2)
    plain = model.carry(model.constrain(problem.null_matrix), T1, T2)
    squares = model.squares(model.residual(best.detach(), x1, x2))
    fits = weighted_mean(squares[..., None], problem.present) < MAX_MINIMAL_DISTANCE**2
    M = torch.where(fits[..., None], best, plain)
    return torch.div(M, torch.linalg.matrix_norm(M, keepdim=True))
