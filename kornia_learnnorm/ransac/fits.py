"""The fits of RANSAC's hypotheses: local optimisation, and the final fit of the best ones to all correspondences."""

import math
from typing import Any

import torch
from torch import Tensor

from kornia_learnnorm.estimators.camera_evidence import contradict_cameras, keeps_fit
from kornia_learnnorm.estimators.moments import Evidence, descend
from kornia_learnnorm.estimators.optimize import minimize
from kornia_learnnorm.estimators.robust_losses import GemanMcClure, Loss, Truncated
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.scoring import Hypotheses, PairScorer

LOCAL_SCALES = (3.0, 2.0, 1.5, 1.0, 1.0)  # thresholds of the steps: a noisy sample has few inliers
MANIFOLD_SCALES = (3.0, 1.5, 1.0, 1.0)  # thresholds of the steps on the manifold
# Numbers of these steps and their relaxation: bounded losses make steps too short, except for the first, long one.
MANIFOLD_STEPS = ((1, 1.0), (3, 1.3))
TOLERANCE = 1e-3  # cosine of distances and derivatives at which a matrix has converged
LOSS_SCALE = 0.7  # scale of the loss of the final fit, in thresholds
STEPS = 3  # steps of least squares on that loss
MIN_GAIN = 1e-3  # share of the cost that another step may gain; above, Levenberg-Marquardt follows
MAX_LM_STEPS = 10  # steps of Levenberg-Marquardt
LM_RELAXATION = 1.4  # factor on these steps on the manifold
POSE_PIXELS = 2.0  # pixels, scale at which the pose of a matrix without cameras must still fit
POOL_SIZE = 2  # best hypotheses, among which the correspondences in front of both cameras decide
MIN_FRONT_GAIN = 1.1  # by which another one must exceed these: the wrong pose of a plane has many behind a camera


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
        state = minimize(scorer.cost(Truncated(scale * scorer.threshold), scorer.rows), state, 1, TOLERANCE)[1].state
    return scorer.best(state.matrix(), scorer.model.pool_size)


def fit_final(scorer: PairScorer, pool: Hypotheses) -> Any:
    """Return the state of the local optimum over all correspondences, from the hypotheses of the pool."""
    model, threshold = scorer.model, scorer.threshold
    loss = GemanMcClure(LOSS_SCALE * threshold)
    fit = model.reweighted_fit(scorer.x1, scorer.x2, pool.F_mat, [Truncated(threshold), *STEPS * [loss]])
    if fit is None:
        return _fit_on_manifold(scorer, pool.F_mat, loss)
    best = int(fit.cost.argmin())
    state, cost = model.state(fit.F_mat[best : best + 1]), float(fit.cost[best])
    if not float(fit.gain[best]) <= MIN_GAIN:
        optimum = minimize(scorer.cost(loss), state, MAX_LM_STEPS, TOLERANCE)[1]
        state, cost = optimum.state, float(optimum.cost[0])
    # The loss never exceeds that of MSAC, which bounds the cost of an optimum, up to a margin for the scores.
    share = 1 - float(pool.score[0]) / scorer.terms.shape[-1]
    most = threshold**2 * (1.1 * share * scorer.x1.shape[-1] + model.sample_size)
    return state if cost <= most else model.state(pool.F_mat[:1])


def _fit_on_manifold(scorer: PairScorer, M: Tensor, loss: Loss) -> Any:
    """Return the state of the local optimum of the model, from the matrices (K, 3, 3), best first.

    Correspondences behind a camera are mismatches: they neither vote nor count in the fit. Where the correspondences
    contradict the cameras, the optimum is that of fundamental matrices, if its pose still fits.
    """
    model = scorer.model
    evidence = Evidence.from_points(scorer.x1[None], scorer.x2[None]) if isinstance(model, Essential) else None
    for pool in (M[:POOL_SIZE], M):
        state: Any = model.state(pool)
        gains = (1 - (scorer.distances(pool) / scorer.threshold).square()).clamp(min=0).nan_to_num(0.0)
        weights = torch.ones_like(gains)
        if evidence is not None:
            weights = evidence.in_front(state, gains[None], len(pool))[0].to(gains)
        votes = (gains * weights).sum(-1)
        best, other = int(votes[:POOL_SIZE].argmax()), int(votes.argmax())
        best = other if float(votes[other]) > MIN_FRONT_GAIN * float(votes[best]) else best
        if float(gains[best].sum()) <= MIN_FRONT_GAIN * float(votes[best]):
            break  # no other hypothesis can exceed it by that factor
    state, weights = type(state)(*(value[best : best + 1] for value in state)), weights[best : best + 1]
    cost = scorer.cost(loss, weights=weights)._replace(relaxation=LM_RELAXATION)
    state = minimize(cost, state, MAX_LM_STEPS, TOLERANCE)[1].state
    square_scale = weights.new_full((1, 1), (LOSS_SCALE * scorer.threshold) ** 2)
    if evidence is None or not bool(contradict_cameras(evidence, state, weights, square_scale)):
        return state
    free = minimize(cost, Fundamental().state(state.matrix()), MAX_LM_STEPS, TOLERANCE)[1].state
    pose: Any = model.state(free.matrix())
    return free if bool(keeps_fit(evidence, state, pose, weights, square_scale.clamp(min=POSE_PIXELS**2))) else state
