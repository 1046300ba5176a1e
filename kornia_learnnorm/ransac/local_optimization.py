"""Local optimisation of RANSAC's hypotheses."""

import math

import torch
from torch import Tensor

from kornia_learnnorm.estimators.moments import Evidence, descend
from kornia_learnnorm.estimators.optimize import minimize
from kornia_learnnorm.estimators.robust_losses import Truncated
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.ransac.scoring import Hypotheses, PairScorer

LOCAL_SCALES = (3.0, 2.0, 1.5, 1.0, 1.0)  # thresholds of the steps: a noisy sample has few inliers
MANIFOLD_SCALES = (3.0, 1.5, 1.0, 1.0)  # thresholds of the steps on the manifold
# Number of these steps and their relaxation: bounded losses make them too short, but the first one comes from afar.
MANIFOLD_STEPS = ((1, 1.0), (3, 1.3))
TOLERANCE = 1e-3  # cosine of distances and derivatives at which a matrix has converged


def optimize_locally(scorer: PairScorer, M: Tensor) -> Hypotheses:
    """Return the best of the matrices (K, 3, 3) fitted to their inliers among the scored correspondences.

    Reference:
        O. Chum, J. Matas, J. Kittler, Locally optimized RANSAC, DAGM 2003.
    """
    losses = [Truncated(scale * scorer.threshold) for scale in LOCAL_SCALES]
    fit = scorer.model.reweighted_fit(scorer.x1[:, scorer.rows], scorer.x2[:, scorer.rows], M, losses)
    if fit is not None:
        return scorer.best(fit.F_mat, scorer.model.pool_size)
    state = scorer.model.state(M)
    if isinstance(scorer.model, Essential):
        every = math.ceil(scorer.terms.shape[-1] / scorer.model.prescored)
        x1, x2 = (x[None, :, scorer.rows][..., ::every] for x in (scorer.x1, scorer.x2))
        evidence, weights = Evidence.from_points(x1, x2), torch.ones_like(x1[:, :1]).expand(-1, len(M), -1)
        scales = iter(MANIFOLD_SCALES)

        def square_scale(squares: Tensor) -> Tensor:
            return squares.new_full((1, 1, 1), (next(scales) * scorer.threshold) ** 2)

        for steps, relaxation in MANIFOLD_STEPS:
            state = descend(evidence, state, weights, square_scale, steps, relaxation)
        return scorer.best(state.matrix(), scorer.model.pool_size)
    for scale in MANIFOLD_SCALES:
        cost = scorer.cost(Truncated(scale * scorer.threshold), scorer.rows)
        state = minimize(cost, state, 1, TOLERANCE)[1].state
    return scorer.best(state.matrix(), scorer.model.pool_size)
