r"""Refinement of the learned fundamental matrix, and the search among samples before its last fit."""

from collections.abc import Callable

import torch
from torch import Tensor

from kornia_learnnorm.estimators.moments import Evidence, descend, geometric_scale, least_cost, pick
from kornia_learnnorm.estimators.stages import Refinement
from kornia_learnnorm.estimators.weighted_samples import evenly_ranked, fit_samples, sample_null_spaces
from kornia_learnnorm.geometry.checks import is_known_true
from kornia_learnnorm.geometry.seven_point import fundamental_in_span
from kornia_learnnorm.models.fundamental import Rank2

COMPARED_SCALE, FIT_SCALE = 2.2, 3.0  # of comparisons and of fits on moments, in geometric means of the distances
LAST_FLOOR = 0.002  # of the frame's unit, about half a pixel, added to the last scale
LAST_POWER = 0.2  # of the probabilities in the last fit: most matches are to count, and a robust loss drops outliers
FIRST_STEPS, LOCAL_STEPS = 1, 3  # reweightings of the network's matrix before the search, and of candidates
SEARCH_STEPS = 6  # of the last stage's steps that a search takes the place of
RELAXATION = 1.3  # of a step: the curvature of a robust loss is less than its weights
SQUARE_FLOOR = 1e-10  # of the frame's unit squared, added to squared distances before their logarithm
MAX_SCORED = 128  # matches by which the matrices of samples are compared first
SHORTLIST = 6  # matrices of samples that are compared on all matches
# Matches, and the sum of their probabilities, from which samples are drawn: among few, some fit most of them by chance.
MIN_MATCHES, MIN_INLIERS = 16, 8


class FundamentalRefinement(Refinement):
    r"""The refinement of a stage's fundamental matrices, and in the last stage a search among samples.

    Sets of at least 16 matches, eight of which are to be inliers, are searched: the network's matrix competes with
    those of samples that are drawn by the probabilities of inliers, minimal ones and larger ones, which average the
    noise. The one of least cost of all matches, whatever their probabilities, is fitted to them by reweighted least
    squares.
    """

    min_searched = MIN_MATCHES

    def optimize(self, M: Tensor, probability: Tensor, steps: int, last: bool) -> Tensor:
        """Return the matrices after so many steps; in the last stage, searched sets take some from their best one.

        The choice among matrices has no derivative; through a zero, the transforms still get a gradient of zero.
        """
        if not (last and steps and self.samples):
            return super().optimize(M, probability, steps, last)
        weights = probability if self.weights is None else probability * self.weights
        evidence, mean = Evidence.from_points(self.x1, self.x2), geometric_scale(weights, self.model.dof, SQUARE_FLOOR)
        with torch.no_grad():
            own = descend(
                evidence, self.model.state(M), weights[:, None], lambda s: FIT_SCALE**2 * mean(s), FIRST_STEPS
            ).matrix()
            best = self._most_consistent(evidence, torch.stack([own, M], 1), weights, mean)
        state = Rank2(best.axes + 0.0 * M[:, None], best.A)
        power = probability.clamp(min=torch.finfo(M.dtype).tiny) ** LAST_POWER
        power = power if self.weights is None else power * self.weights
        # The scale moves along, so that derivatives don't depend on where the fit began.
        options = (lambda s: FIT_SCALE**2 * mean(s) + LAST_FLOOR**2), max(1, steps - SEARCH_STEPS), RELAXATION
        fitted: Tensor = descend(evidence, state, power[:, None], *options).matrix()
        present = weights > 0
        few = (present.sum(1) < MIN_MATCHES) | ((probability * present).sum(1) < MIN_INLIERS)
        if is_known_true(~few.any()):
            return fitted
        return torch.where(few[:, None, None], super().optimize(M, probability, steps, last), fitted)

    def _most_consistent(
        self, evidence: Evidence, M: Tensor, weights: Tensor, mean: Callable[[Tensor], Tensor]
    ) -> Rank2:
        """Return the states of least cost of all matches among matrices (B, S, 3, 3) and those of samples.

        The scale of the cost is that of the matrix with the least mean distance: weights may be poor.
        """
        present = (weights > 0).to(weights)
        # Matches in the order of their weights: samples and choices don't depend on the order that they came in.
        order = weights.argsort(dim=1, descending=True, stable=True)
        drawn, real = self._draw(evidence, weights, order)
        some = evenly_ranked(order, present, MAX_SCORED)
        squares = evidence.single().select(some).squares(drawn.float())[0]
        means = geometric_scale(weights.gather(1, some).to(squares), self.model.dof, LAST_FLOOR**2)(squares)[..., 0]
        least = torch.where(real & means.isfinite(), means, torch.inf).amin(1)[:, None, None].to(M)
        square_scale = COMPARED_SCALE**2 * mean(evidence.squares(M)[0]).amin(1, keepdim=True).minimum(least)
        losses = squares.div_(squares + square_scale.to(squares))  # of Geman and McClure
        M = torch.cat([M, least_cost(drawn, real, losses, present.gather(1, some), SHORTLIST)], 1)
        state, number = self.model.state(M.flatten(0, 1)), M.shape[1]
        state = descend(
            evidence, state, present[:, None].expand(-1, number, -1), lambda _: square_scale, LOCAL_STEPS, RELAXATION
        )
        losses = evidence.losses(torch.unflatten(state.matrix(), 0, (-1, number)), square_scale)
        best: Rank2 = pick(state, (losses @ present[..., None])[..., 0].argmin(1), number)
        return best

    def _draw(self, evidence: Evidence, weights: Tensor, order: Tensor) -> tuple[Tensor, Tensor]:
        """Return the matrices of samples, (B, S, 3, 3), and which of them are real.

        Those of large samples, a third, and those of minimal ones unless a set has few outliers.
        """
        large = self.model.constrain(fit_samples(evidence, weights, order, -(-self.samples // 3)))
        real = torch.ones_like(large[..., 0, 0], dtype=torch.bool)
        if self.all_settled:
            return large, real
        basis, determined = sample_null_spaces(evidence, weights, order, self.samples, self.model.sample_size)
        drawn, singular = fundamental_in_span(basis.flatten(0, 1))
        shape = -1, 3 * self.samples
        singular = singular.view(shape) & determined.repeat_interleave(3, 1)
        if self.few_outliers is not None:
            singular = singular & ~self.few_outliers[:, None]
        return torch.cat([large, drawn.view(*shape, 3, 3)], 1), torch.cat([real, singular], 1)
