"""Test whether correspondences contradict the cameras that a pose was estimated with."""

import torch
from torch import Tensor

from kornia_learnnorm.estimators.moments import Evidence
from kornia_learnnorm.estimators.optimize import UNROLLED_LOSS
from kornia_learnnorm.geometry.checks import safe_divisor
from kornia_learnnorm.geometry.dlt import normal_equations, row_products
from kornia_learnnorm.models.essential import Calibrated, Essential
from kornia_learnnorm.models.fundamental import Fundamental

SIGNIFICANCE = 1e-3  # largest probability that noise alone contradicts the cameras as much
MIN_EFFECT = 0.05  # share of the noise that two more parameters must explain: errors of matches are not independent
MIN_NOISE = 0.01  # of the loss's scale: where inliers have no noise, the pull of outliers is no evidence
MIN_KEPT = 0.3  # share of the fit with cameras that the pose of a matrix without them must keep
MIN_PRECISION = 1 / 9  # of a pose without cameras over that with them: at most three times the standard error


@torch.no_grad()
def contradict_cameras(evidence: Evidence, state: Calibrated, weights: Tensor, square_scale: Tensor) -> Tensor:
    r"""Return for which sets a pose estimated without cameras is more reliable, (B,) bool.

    The states are optima of weights (B, N) and of Geman and McClure's loss of a squared scale (B, 1). By a score test,
    the gain of a Gauss-Newton step of seven parameters over one of five, divided by the mean of :math:`\psi^2` and
    times that of its slope, where :math:`\psi(d)` is half of the loss's derivative, is twice an F-distributed number of
    2 and :math:`m` degrees of freedom: it is above :math:`2x` with probability :math:`(1 + 2x / m)^{-m / 2}`. Errors of
    neighbouring matches are not independent, so the step must also explain a twentieth of the noise, which is a
    hundredth of the scale at least. And the pose must not become much less certain, as it does where a plane leaves
    seven parameters nearly undetermined.

    Reference:
        F. Hampel, E. Ronchetti, P. Rousseeuw, W. Stahel, Robust Statistics, 1986, section 7.2.
    """
    F_mat = state.matrix()
    squares, factor = (value[:, 0] for value in evidence.squares(F_mat[:, None]))
    inner = weights * UNROLLED_LOSS(squares / square_scale)[1]
    M, difference = evidence.forms((inner * factor)[:, None], squares[:, None], row_products(evidence.products))
    cost = (inner * squares).sum(1)
    free = torch.linalg.matrix_norm(F_mat, keepdim=True) * Fundamental().state(F_mat).tangents()
    tangents = state.tangents()
    pose = torch.linalg.solve_ex(tangents.mT @ tangents, tangents.mT @ free)[0]  # nearest steps with cameras
    e = F_mat.mT.reshape(-1, 9, 1)
    scale = cost / safe_divisor((e.mT @ M @ e)[:, 0, 0])
    gains, variances = [], []
    for D, steps in ((tangents, torch.eye(Essential.dof).to(pose)), (free, pose)):
        normal, gradient = normal_equations(M, difference @ e, D)
        inverse = torch.linalg.inv_ex(normal)[0]
        gains.append((gradient.mT @ inverse @ gradient)[:, 0, 0] * scale)
        variances.append((steps @ inverse @ steps.mT).diagonal(dim1=-2, dim2=-1).sum(-1))
    noise = (inner.square() / weights.clamp(min=torch.finfo(weights.dtype).tiny) * squares).sum(1)
    noise = noise + inner.sum(1) * MIN_NOISE**2 * square_scale[:, 0]
    freedom = (inner.sum(1) - Fundamental.dof).clamp(min=1.0)
    effect = (gains[1] - gains[0]) * inner.sum(1) / noise / freedom
    least = (SIGNIFICANCE ** (-2 / freedom) - 1).clamp(min=MIN_EFFECT)
    return torch.logical_and(effect > least, variances[0] > MIN_PRECISION * variances[1])


@torch.no_grad()
def keeps_fit(
    evidence: Evidence, state: Calibrated, other: Calibrated, weights: Tensor, square_scale: Tensor
) -> Tensor:
    """Return for which sets the other states fit at least 0.3 times as well as the states, (B,) bool.

    Where a plane leaves a fundamental matrix nearly undetermined, its pose may fit hardly any correspondence, while
    inexact cameras cost a few pixels, which the squared scale (B, 1) must allow for.
    """
    losses = evidence.losses(torch.stack([state.matrix(), other.matrix()], 1), square_scale[:, None])
    fit = ((1 - losses) @ weights[..., None])[..., 0]
    return torch.gt(fit[:, 1], MIN_KEPT * fit[:, 0])
