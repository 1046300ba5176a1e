"""Local optimisation of RANSAC's hypotheses, and the final fit of the best ones."""

import math
from typing import Any

import torch
from torch import Tensor

from kornia_learnnorm.estimators.camera_evidence import contradict_cameras, in_front_of_best_pose, keeps_fit
from kornia_learnnorm.estimators.moments import Evidence, descend
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.estimators.robust_losses import GemanMcClure, Loss, Truncated
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.scoring import PRESCORED, Hypotheses, PairScorer

LOCAL_SCALES = (3.0, 2.0, 1.5, 1.0, 1.0)  # thresholds of local optimisation's steps: a noisy sample has few inliers
FINAL_LOSS_SCALE = 0.7  # scale of the final fit's loss, in thresholds
FINAL_STEPS = 3  # steps of least squares on that loss
FINAL_GAIN = 1e-3  # share of the cost that least squares may leave to gain; above, Levenberg-Marquardt goes on
MAX_LM_STEPS = 10  # steps of Levenberg-Marquardt
LM_TOLERANCE = 1e-3  # cosine of distances and derivatives at which it has converged
MANIFOLD_SCALES = (3.0, 1.5, 1.0, 1.0)  # thresholds of local optimisation's steps on the manifold
# Number of these steps and their relaxation: bounded losses make them too short, but the first one comes from afar.
MANIFOLD_STEPS = ((1, 1.0), (3, 1.3))
LM_RELAXATION = 1.4  # of those of Levenberg-Marquardt on the manifold
POSE_PIXELS = 2.0  # scale at which the pose of a matrix that left the cameras must still fit
MANIFOLD_POOL_SIZE = 2  # best hypotheses, of which correspondences in front of both cameras choose one


def optimize_locally(scorer: PairScorer, M: Tensor, number: int) -> Hypotheses:
    """Return the best of the matrices (K, 3, 3) fitted to their inliers among the scored correspondences.

    Reference:
        O. Chum, J. Matas, J. Kittler, Locally optimized RANSAC, DAGM 2003.
    """
    losses = [Truncated(scale * scorer.threshold) for scale in LOCAL_SCALES]
    fit = scorer.model.reweighted_fit(scorer.x1[:, scorer.rows], scorer.x2[:, scorer.rows], M, losses)
    if fit is not None:
        return scorer.best(fit.F_mat, number)
    state = scorer.model.state(M)
    if isinstance(scorer.model, Essential):
        every = math.ceil(scorer.terms.shape[-1] / PRESCORED)
        x1, x2 = (x[None, :, scorer.rows][..., ::every] for x in (scorer.x1, scorer.x2))
        evidence, weights = Evidence.from_points(x1, x2), torch.ones_like(x1[:, :1]).expand(-1, len(M), -1)
        scales = iter(MANIFOLD_SCALES)

        def square_scale(squares: Tensor) -> Tensor:
            return squares.new_full((1, 1, 1), (next(scales) * scorer.threshold) ** 2)

        for steps, relaxation in MANIFOLD_STEPS:
            state = descend(evidence, state, weights, square_scale, steps, relaxation)
        return scorer.best(state.matrix(), number)
    for scale in MANIFOLD_SCALES:
        cost = _cost(scorer, Truncated(scale * scorer.threshold), scorer.rows)
        state = minimize(cost, state, 1, LM_TOLERANCE)[1].state
    return scorer.best(state.matrix(), number)


def fit_final(scorer: PairScorer, pool: Hypotheses) -> Any:
    """Return the optimum (1, 3, 3) on all correspondences that is next to the best of the pool."""
    model, threshold = scorer.model, scorer.threshold
    loss = GemanMcClure(FINAL_LOSS_SCALE * threshold)
    fit = model.reweighted_fit(scorer.x1, scorer.x2, pool.F_mat, [Truncated(threshold), *FINAL_STEPS * [loss]])
    if fit is None:
        return _fit_on_manifold(scorer, pool.F_mat[:MANIFOLD_POOL_SIZE], loss)
    best = int(fit.cost.argmin())
    state, cost = model.state(fit.F_mat[best : best + 1]), float(fit.cost[best])
    if not float(fit.gain[best]) <= FINAL_GAIN:
        optimum = minimize(_cost(scorer, loss), state, MAX_LM_STEPS, LM_TOLERANCE)[1]
        state, cost = optimum.state, float(optimum.cost[0])
    return state if cost <= _largest_cost(scorer, pool) else model.state(pool.F_mat[:1])


def _fit_on_manifold(scorer: PairScorer, M: Tensor, loss: Loss) -> Any:
    """Return the optimum (1, 3, 3) of the model that is next to the best of some matrices (K, 3, 3).

    Correspondences behind a camera are mismatches: they neither vote nor count in the fit. Where the correspondences
    contradict the cameras, the optimum is that of fundamental matrices, if its pose still fits.
    """
    model = scorer.model
    state: Any = model.state(M)
    gains = (1 - (scorer.distances(M) / scorer.threshold).square()).clamp(min=0).nan_to_num(0.0)
    weights, evidence = torch.ones_like(gains), None
    if isinstance(model, Essential):
        evidence = Evidence.from_points(scorer.x1[None], scorer.x2[None])
        weights = in_front_of_best_pose(evidence, state, gains[None], len(M))[0].to(gains)
    best = int((gains * weights).sum(-1).argmax())
    state, weights = type(state)(*(value[best : best + 1] for value in state)), weights[best : best + 1]
    losses = Truncated(scorer.threshold), loss
    near, last = (_cost(scorer, rho, weights=weights)._replace(relaxation=LM_RELAXATION) for rho in losses)
    state = minimize(near, state, 1, LM_TOLERANCE)[1].state
    state = minimize(last, state, MAX_LM_STEPS, LM_TOLERANCE)[1].state
    square_scale = weights.new_full((1, 1), (FINAL_LOSS_SCALE * scorer.threshold) ** 2)
    if evidence is None or not bool(contradict_cameras(evidence, state, weights, square_scale)):
        return state
    free = minimize(last, Fundamental().state(state.matrix()), MAX_LM_STEPS, LM_TOLERANCE)[1].state
    pose: Any = model.state(free.matrix())
    wide = square_scale.clamp(min=POSE_PIXELS**2)
    return free if bool(keeps_fit(evidence, state, pose, weights, wide)) else state


def _cost(
    scorer: PairScorer, loss: Loss, rows: Tensor | slice = slice(None), weights: Tensor | None = None
) -> RobustCost:
    x1, x2 = scorer.x1[None, :, rows], scorer.x2[None, :, rows]
    return RobustCost(scorer.model, x1, x2, torch.ones_like(x1[:, 0]) if weights is None else weights, loss)


def _largest_cost(scorer: PairScorer, pool: Hypotheses) -> float:
    """Return what an optimum costs at most: the loss is nowhere above that of MSAC, up to a margin for the scores."""
    share = 1 - float(pool.score[0]) / scorer.terms.shape[-1]
    most: float = scorer.threshold**2 * (1.1 * share * scorer.x1.shape[-1] + scorer.model.sample_size)
    return most
