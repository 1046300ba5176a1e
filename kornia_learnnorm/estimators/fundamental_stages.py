r"""Refinement of the learned fundamental matrix, and the search among minimal samples before its last fit."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_learnnorm.estimators.match_features import CommonFrame
from kornia_learnnorm.estimators.moments import (
    Evidence,
    descend,
    draw_samples,
    evenly_ranked,
    geometric_scale,
    least_cost,
    pick,
)
from kornia_learnnorm.estimators.optimize import differentiable_state
from kornia_learnnorm.estimators.stages import Refinement
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.seven_point import fundamental_in_span
from kornia_learnnorm.models.contract import TwoViewModel
from kornia_learnnorm.models.fundamental import Rank2

__all__ = ["FundamentalRefinement"]

# Scales of the robust loss in geometric means of the distances: of the stages, of comparisons, and of the last fit.
STAGE_SCALE, COMPARED_SCALE, LAST_SCALE = 3.0, 1.5, 2.0
LAST_FLOOR = 0.002  # of the frame's unit, about half a pixel, added to the last scale
LAST_POWER = 0.2  # of the probabilities in the last fit: most matches are to count, and a robust loss drops outliers
STAGE_STEPS, LOCAL_STEPS = 3, 4  # reweightings of a stage's matrix, and of candidates
SQUARE_FLOOR = 1e-10  # of the frame's unit squared, added to squared distances before their logarithm
SAMPLE_SIZE = 7
MAX_SCORED = 256  # matches by which the matrices of minimal samples are compared first
SHORTLIST = 4  # matrices of minimal samples that are compared on all matches
# Matches, and the sum of their probabilities, from which samples are drawn: among few, some fit most of them by chance.
MIN_MATCHES, MIN_INLIERS = 16, 8


class FundamentalRefinement(Refinement):
    r"""Reweighted least squares of a stage's fundamental matrices on Geman and McClure's loss of Sampson distances.

    In the last stage, sets of at least 16 matches, eight of which are to be inliers, are searched: the matrix competes
    with those of minimal samples that are drawn by the probabilities of inliers, and the one of least cost of all
    matches, whatever their probabilities, is fitted to them.
    """

    def __init__(self, model: TwoViewModel, problem: LinearProblem, frame: CommonFrame, samples: int) -> None:
        super().__init__(model, problem, frame)
        self.evidence = Evidence.from_points(self.x1, self.x2)
        # A traced program serves sets of any size.
        self.samples = samples if torch.compiler.is_compiling() or self.x1.shape[-1] >= MIN_MATCHES else 0

    def optimize(self, M: Tensor, probability: Tensor, steps: int, last: bool) -> Tensor:
        """Return the matrices after so many steps, and in the last stage a search among minimal samples."""
        weights = probability if self.weights is None else probability * self.weights
        state = differentiable_state(self.model, M / torch.linalg.matrix_norm(M, keepdim=True))
        mean = geometric_scale(weights, self.model.dof, SQUARE_FLOOR)

        def square(state: Rank2) -> Tensor:
            """Return the squared geometric means of the distances, (B, 1, 1)."""
            return mean(self.evidence.squares(state.matrix()[:, None])[0])

        def fit(state: Rank2, weights: Tensor, square_scale: Tensor, steps: int) -> Rank2:
            found: Rank2 = descend(self.evidence, state, weights[:, None], lambda _: square_scale, steps)
            return found

        scale = STAGE_SCALE**2 * square(state)
        state = fit(state, weights, scale, min(steps, STAGE_STEPS))
        if not last or steps == 0:
            return state.matrix()
        if not self.samples:
            return fit(state, weights, scale, steps).matrix()
        with torch.no_grad():
            found = self._most_consistent(torch.stack([state.matrix(), M], 1), weights, square(state))
        present = weights > 0
        few = (present.sum(1) < MIN_MATCHES) | ((probability * present).sum(1) < MIN_INLIERS)
        few = few[:, None, None]
        # The choice has no derivative; through the zero, transforms still get a gradient of zero.
        axes = torch.where(few[..., None], state.axes, found.axes + 0.0 * state.axes)
        state = Rank2(axes, torch.where(few, state.A, found.A + 0.0 * state.A))
        power = probability.clamp(min=torch.finfo(M.dtype).tiny) ** LAST_POWER
        power = power if self.weights is None else power * self.weights
        power = torch.where(few[..., 0], weights, power)[:, None]

        def square_scale(squares: Tensor) -> Tensor:
            """Return a scale that moves along, so that derivatives don't depend on where the fit began."""
            return torch.where(few, scale, LAST_SCALE**2 * mean(squares) + LAST_FLOOR**2)

        state = descend(self.evidence, state, power, square_scale, steps)
        refined: Tensor = state.matrix()
        return refined

    def _most_consistent(self, M: Tensor, weights: Tensor, square_mean: Tensor) -> Rank2:
        """Return the states of least cost of all matches among matrices (B, S, 3, 3) and those of minimal samples."""
        evidence, present, square_scale = self.evidence, (weights > 0).to(weights), COMPARED_SCALE**2 * square_mean
        # Matches in the order of their weights: samples and choices don't depend on the order that they came in.
        order = weights.argsort(dim=1, descending=True, stable=True)
        basis, determined = draw_samples(evidence, weights, order, self.samples, SAMPLE_SIZE)
        drawn, real = fundamental_in_span(basis)
        drawn = drawn.view(-1, 3 * self.samples, 3, 3)
        real = (real & determined[:, None]).view(-1, 3 * self.samples)
        some = evenly_ranked(order, MAX_SCORED)
        losses = evidence.single().select(some).losses(drawn.float(), square_scale)
        M = torch.cat([M, least_cost(drawn, real, losses, present.gather(1, some), SHORTLIST)], 1)
        state, number = self.model.state(M.flatten(0, 1)), M.shape[1]
        state = descend(evidence, state, present[:, None].expand(-1, number, -1), lambda _: square_scale, LOCAL_STEPS)
        losses = evidence.losses(torch.unflatten(state.matrix(), 0, (-1, number)), square_scale)
        best: Rank2 = pick(state, (losses @ present[..., None])[..., 0].argmin(1), number)
        return best
