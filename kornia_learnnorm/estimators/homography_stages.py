r"""Refinement of the learned homography by reweighted least squares, and the search among minimal samples before it.

Correspondences enter a step through the :math:`9 \times 9` matrix of the second moments of their design rows alone,
which weighted moments of view 1's points make: a step costs little for ten matches and for thousands.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from kornia_learnnorm.estimators.moments import geometric_scale, least_cost
from kornia_learnnorm.estimators.network_features import CommonFrame
from kornia_learnnorm.estimators.optimize import UNROLLED_LOSS
from kornia_learnnorm.estimators.stages import Refinement
from kornia_learnnorm.estimators.weighted_samples import draw_matches, evenly_ranked
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.homography import Homography, solve_four_points, squared_distances

# Of the robust loss, in geometric means of the inliers' distances: of early stages, comparisons and the last fit.
EARLY_SCALE, COMPARED_SCALE, LAST_SCALE = 3.0, 1.5, 6.0
NEAR = 3.0  # geometric means, up to about which distances count in the mean itself in evaluation
LAST_POWER = 0.05  # of the probabilities in the last fit: most matches are to count, and a robust loss drops outliers
SQUARE_FLOOR = 1e-10  # of the frame's unit squared, added to squared distances before their logarithm
LOCAL_STEPS = 2  # reweightings of candidates
MAX_SCORED = 128  # matches by which candidates are compared
SHORTLIST = 2  # matrices of minimal samples that are refined
MIN_MARGIN = 1e-3  # of the frame's unit, by which a minimal sample has to miss being degenerate
MIN_MATCHES = 8  # from which samples are drawn: among few, some fit most of them by chance


class HomographyRefinement(Refinement):
    r"""Reweighted least squares of a stage's homographies, and in the last stage a search among minimal samples.

    Matches are weighted by the probabilities of inliers and the derivative of Geman and McClure's loss of squared
    distances :math:`r` over a squared scale, :math:`(1 + r)^{-2}`. In the last stage these are probabilities to the
    power of 0.05 and :math:`(1 + r^2)^{-2}`, which leaves inliers nearly equal weights; sets of at least eight matches
    start from their refined matrix or one of minimal samples that are drawn by the probabilities of inliers, whichever
    has the least cost of all matches, whatever their probabilities.
    """

    model: Homography
    min_searched = MIN_MATCHES

    def __init__(
        self, model: Homography, problem: LinearProblem, frame: CommonFrame, samples: int, settle: bool
    ) -> None:
        super().__init__(model, problem, frame, samples, settle)
        products = (self.x1[:, :, None] * self.x1[:, None]).flatten(1, 2)
        self.evidence = model.sampson_terms(self.x1, self.x2), products

    def optimize(self, M: Tensor, probability: Tensor, steps: int, last: bool) -> Tensor:
        """Return the matrices after so many steps.

        The choice among matrices has no derivative; through a zero, the transforms still get a gradient of zero.
        """
        inliers = probability if self.weights is None else probability * self.weights
        near = NEAR if self.settle else None
        mean, weights = geometric_scale(inliers, self.model.dof, SQUARE_FLOOR, near), inliers
        if last:
            weights = probability.clamp(min=torch.finfo(M.dtype).tiny) ** LAST_POWER
            weights = weights if self.weights is None else weights * self.weights
        M = (M / torch.linalg.matrix_norm(M, keepdim=True))[:, None]

        def weigh(squares: Tensor) -> Tensor:
            if last:
                return weights[:, None] * UNROLLED_LOSS((squares / (LAST_SCALE**2 * mean(squares))).square())[1]
            return weights[:, None] * UNROLLED_LOSS(squares / (EARLY_SCALE**2 * mean(squares)))[1]

        if last and steps and self.samples:
            with torch.no_grad():
                own = self._descend(M, self.evidence, weigh, LOCAL_STEPS)
                squares = self.model.sampson_squares(own, self.evidence[0])[0]
                best = self._most_consistent(own, inliers, COMPARED_SCALE**2 * mean(squares))
            few = (inliers > 0).sum(1) < MIN_MATCHES
            M = torch.where(few[:, None, None, None], M, best + 0.0 * M)
        return self._descend(M, self.evidence, weigh, steps)[:, 0]

    def _most_consistent(self, own: Tensor, inliers: Tensor, square_scale: Tensor) -> Tensor:
        """Return the matrices of least cost, (B, 1, 3, 3), among own ones and those of minimal samples."""
        # Matches in the order of their weights: samples and choices don't depend on the order that they came in.
        order = inliers.argsort(dim=1, descending=True, stable=True)
        drawn = draw_matches(inliers, order, self.samples, self.model.sample_size)
        x1, x2 = (
            torch.unflatten(x.gather(2, drawn[:, None].expand(-1, 3, -1)), 2, (self.samples, -1)).permute(0, 2, 3, 1)
            for x in (self.x1, self.x2)
        )
        M, margin = (
            torch.unflatten(value, 0, (-1, self.samples))
            for value in solve_four_points(x1.flatten(0, 1), x2.flatten(0, 1))
        )
        present = (inliers > 0).to(inliers)
        some = evenly_ranked(order, present, MAX_SCORED)
        few = present.gather(1, some)
        terms, products = (value.gather(2, some[:, None].expand(-1, value.shape[1], -1)) for value in self.evidence)

        def losses(M: Tensor, terms: Tensor) -> Tensor:
            return UNROLLED_LOSS(self.model.sampson_squares(M, terms)[0] / square_scale.to(M))[0]

        def weigh(squares: Tensor) -> Tensor:
            return few[:, None] * UNROLLED_LOSS(squares / square_scale)[1]

        M = least_cost(M, margin > MIN_MARGIN, losses(M.float(), terms.float()), few, SHORTLIST)
        M = torch.cat([own, self._descend(M, (terms, products), weigh, LOCAL_STEPS)], 1)
        return least_cost(M, M.isfinite().all((2, 3)), losses(M, self.evidence[0]), present, 1)

    def _descend(
        self, M: Tensor, evidence: tuple[Tensor, Tensor], weigh: Callable[[Tensor], Tensor], steps: int
    ) -> Tensor:
        """Return the matrices (B, K, 3, 3) after steps of reweighted least squares; differentiable."""
        terms, products = evidence
        for _ in range(steps):
            parts = self.model.sampson_parts(M, terms)
            M = self.model.reweighted_step(M, terms, products, parts, weigh(squared_distances(parts)))[0]
        return M
