"""Local optimisation of RANSAC's hypotheses, and the final fit of the best ones."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_learnnorm.estimators.epipolar_cost import EpipolarCost
from kornia_learnnorm.estimators.refinement import minimize
from kornia_learnnorm.estimators.robust_losses import GemanMcClure, Loss, Truncated
from kornia_learnnorm.geometry.manifold import Calibrated, Rank2, decompose
from kornia_learnnorm.geometry.pose import in_front_of_best_pose
from kornia_learnnorm.ransac.constrained_fit import constrained_fit
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE
from kornia_learnnorm.ransac.scoring import Hypotheses, PairScorer

__all__ = ["fit_final", "fit_final_calibrated", "optimize_calibrated", "optimize_locally"]

LOCAL_SCALES = (3.0, 2.0, 1.5, 1.0, 1.0)  # thresholds of local optimisation's steps: a noisy sample has few inliers
FINAL_POOL_SIZE = 4  # best hypotheses that the final fit starts from
FINAL_LOSS_SCALE = 0.7  # scale of the final fit's loss, in thresholds
FINAL_STEPS = 3  # steps of least squares on that loss
FINAL_GAIN = 1e-3  # share of the cost that least squares may leave to gain; above, Levenberg-Marquardt goes on
MAX_LM_STEPS = 10  # steps of Levenberg-Marquardt
LM_TOLERANCE = 1e-3  # cosine of distances and derivatives at which it has converged
CALIBRATED_SCALES = (3.0, 1.5, 1.0)  # thresholds of local optimisation's stages, with cameras
CALIBRATED_STEPS = 2  # steps of Levenberg-Marquardt in a stage
SIGNIFICANCE = 1e-3  # probability that noise alone speaks against cameras as much
MIN_NOISE = 0.01  # thresholds; smaller distances don't speak against cameras


def optimize_locally(scorer: PairScorer, F_mat: Tensor, number: int) -> Hypotheses:
    """Return the best of the matrices (K, 3, 3) fitted to their inliers among the scored correspondences.

    Reference:
        O. Chum, J. Matas, J. Kittler, Locally optimized RANSAC, DAGM 2003.

    """
    losses = [Truncated(scale * scorer.threshold) for scale in LOCAL_SCALES]
    x1, x2 = scorer.x1[:, scorer.rows], scorer.x2[:, scorer.rows]
    return scorer.best(constrained_fit(x1, x2, F_mat, losses, scorer.scale).F_mat, number)


def optimize_calibrated(scorer: PairScorer, state: Calibrated, number: int) -> Hypotheses:
    """Return the best of the essential matrices fitted to their inliers among the scored correspondences."""
    for scale in CALIBRATED_SCALES:
        objective = _objective(scorer, Truncated(scale * scorer.threshold), scorer.rows)
        state = minimize(objective, state, CALIBRATED_STEPS, LM_TOLERANCE)[1].state
    return scorer.best(state.matrix(), number)


def fit_final(scorer: PairScorer, pool: Hypotheses) -> Rank2:
    """Return the optimum (1, 3, 3) on all correspondences that is next to the best of the pool."""
    threshold, loss = scorer.threshold, GemanMcClure(FINAL_LOSS_SCALE * scorer.threshold)
    losses: list[Loss] = [Truncated(threshold), *FINAL_STEPS * [loss]]
    fit = constrained_fit(scorer.x1, scorer.x2, pool.F_mat[:FINAL_POOL_SIZE], losses, scorer.scale)
    best = int(fit.cost.argmin())
    state, cost = decompose(fit.F_mat[best : best + 1]), float(fit.cost[best])
    if not float(fit.gain[best]) <= FINAL_GAIN:
        optimum = minimize(_objective(scorer, loss), state, MAX_LM_STEPS, LM_TOLERANCE)[1]
        state, cost = optimum.state, float(optimum.cost[0])
    return state if cost <= _largest_cost(scorer, pool) else decompose(pool.F_mat[:1])


def fit_final_calibrated(scorer: PairScorer, pool: Hypotheses, start: Calibrated) -> Calibrated | Rank2:
    """Return the optimum (1, 3, 3) among essential matrices that is next to the best of the pool.

    Correspondences behind a camera are mismatches: they neither vote nor count in the fit. Where the correspondences
    contradict the cameras, the optimum is that of fundamental matrices.

    Args:
        scorer: all correspondences.
        pool: the best hypotheses.
        start: the best of the pool as essential matrices, the first of them first.

    """
    distances = torch.stack([scorer.distances(F) for F in pool.F_mat[: len(start.A)]])
    gains = (1 - (distances / scorer.threshold).square()).clamp(min=0).nan_to_num(0.0)
    rays1, rays2 = (scorer.x1.mT @ start.C1[0].mT), (scorer.x2.mT @ start.C2[0].mT)
    front = in_front_of_best_pose(start.essential(), rays1, rays2, gains)
    best = int((gains * front).sum(-1).argmax())
    state, weights = Calibrated(*(value[best : best + 1] for value in start)), front[best : best + 1].to(gains)
    near = _objective(scorer, Truncated(scorer.threshold), weights=weights)
    last = _objective(scorer, GemanMcClure(FINAL_LOSS_SCALE * scorer.threshold), weights=weights)
    state = minimize(near, state, CALIBRATED_STEPS, LM_TOLERANCE)[1].state
    state = minimize(last, state, MAX_LM_STEPS, LM_TOLERANCE)[1].state
    before, free = minimize(last, decompose(state.matrix()), MAX_LM_STEPS, LM_TOLERANCE)
    return free.state if _contradicts(last, free.state, float(before - free.cost), scorer.threshold) else state


def _contradicts(objective: EpipolarCost, free: Rank2, gain: float, threshold: float) -> bool:
    r"""Return whether two more parameters lower the cost of Geman and McClure's loss by more than noise would.

    The :math:`\tau` test: the gain over the mean of :math:`\psi^2` and times that of :math:`\psi'`, where
    :math:`\psi(d)` is half of the loss's derivative, is twice an F-distributed number of 2 and :math:`m` degrees of
    freedom, which is above :math:`x` with probability :math:`(1 + 2x / m)^{-m / 2}`.

    Reference:
        F. Hampel, E. Ronchetti, P. Rousseeuw, W. Stahel, Robust Statistics, 1986, section 7.2.

    """
    squares = objective.distances(free.matrix()).square()
    weights = objective.weights * objective.loss(squares)[1]
    freedom = float(weights.sum()) - 7
    if freedom < 1:
        return False
    noise = (squares + (MIN_NOISE * threshold) ** 2) * weights.square()
    slope = weights * (4 * weights.sqrt() - 3)  # of Geman and McClure's psi
    statistic = gain * float(slope.sum() / noise.sum())
    return statistic > freedom * (math.pow(SIGNIFICANCE, -2 / freedom) - 1)


def _objective(
    scorer: PairScorer, loss: Loss, rows: Tensor | slice = slice(None), weights: Tensor | None = None
) -> EpipolarCost:
    x1, x2 = scorer.x1[None, :, rows], scorer.x2[None, :, rows]
    return EpipolarCost(x1, x2, torch.ones_like(x1[:, 0]) if weights is None else weights, scorer.scale, loss)


def _largest_cost(scorer: PairScorer, pool: Hypotheses) -> float:
    """Return what an optimum costs at most: the loss is nowhere above that of MSAC, up to a margin for the scores."""
    share = 1 - float(pool.score[0]) / scorer.terms.shape[-1]
    most: float = scorer.threshold**2 * (1.1 * share * scorer.x1.shape[-1] + SAMPLE_SIZE)
    return most
