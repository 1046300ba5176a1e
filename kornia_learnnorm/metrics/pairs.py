r"""Metrics of an estimated fundamental matrix, one number per image pair, and the comparison of two methods by them.

All distances are symmetric epipolar distances in pixels, the sum :math:`d_1 + d_2` of both points' distances to their
epipolar lines. Others take the larger of the two or their mean, so a threshold of theirs is not one of these.

A failed estimate (NaN or zero matrix) has no inliers and an infinite error. NaN is not a failure: it says that a pair
cannot be measured, and callers drop and count such pairs. The evaluation of NG-RANSAC drops a pair from all three
metrics when the ground truth has no inliers at the threshold or none below 1 px.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.better_rate import bootstrap_means, percentile_interval

__all__ = ["PairedDifference", "epipolar_error", "f1_score", "inlier_share", "paired_bootstrap"]


def inlier_share(
    points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float, mask: Tensor | None = None
) -> Tensor:
    r"""Return the share of correspondences that agree with an estimate, "% inliers" over 100.

    :math:`|\{i : d_i(F) < \tau\}| / N`, strict, with :math:`d` of Fan et al., Eq. 7.

    Args:
        points1: pixels in the first images with shape :math:`(*, N, 2)`.
        points2: pixels in the second images with shape :math:`(*, N, 2)`.
        F_mat: estimated fundamental matrices with shape :math:`(*, 3, 3)`, any scale.
        threshold: symmetric epipolar distance :math:`\tau` that an inlier stays below, pixels.
        mask: true for the correspondences of a padded batch that count, boolean with shape :math:`(*, N)`.

    Returns:
        shares with shape :math:`(*)`; zero for a failed estimate, NaN for a pair without correspondences.

    Raises:
        TypeError: if a tensor is not floating-point, dtypes differ, or the mask is not boolean.
        ShapeError: if a shape is wrong.
        ValueError: if the points do not pair up, the mask does not fit them, or the threshold is not positive.

    Reference:
        R. Ranftl, V. Koltun, Deep Fundamental Matrix Estimation, ECCV 2018, as evaluated by E. Brachmann, C. Rother,
        Neural-Guided RANSAC, ICCV 2019.

    Example:
        >>> F_mat = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # lines are rows
        >>> points1, points2 = torch.tensor([[5.0, 1.0], [5.0, 2.0]]), torch.tensor([[9.0, 1.25], [9.0, 3.0]])
        >>> inlier_share(points1, points2, F_mat, threshold=1.0)  # distances 0.5 and 2
        tensor(0.5000)

    """
    inliers = _inliers(points1, points2, F_mat, threshold, mask)
    total = torch.ones_like(inliers) if mask is None else mask
    return inliers.sum(-1).to(points1.dtype) / total.sum(-1)


def f1_score(
    points1: Tensor, points2: Tensor, F_mat: Tensor, F_true: Tensor, threshold: float, mask: Tensor | None = None
) -> Tensor:
    r"""Return the harmonic mean of precision and recall between the inliers of an estimate and of the ground truth.

    :math:`2 |A \cap B| / (|A| + |B|)` with :math:`A = \{i : d_i(F) < \tau\}` and the same :math:`B` of the true matrix.

    Args:
        points1: pixels in the first images with shape :math:`(*, N, 2)`.
        points2: pixels in the second images with shape :math:`(*, N, 2)`.
        F_mat: estimated fundamental matrices with shape :math:`(*, 3, 3)`, any scale.
        F_true: true fundamental matrices with shape :math:`(*, 3, 3)`, any scale; NaN where unknown.
        threshold: symmetric epipolar distance :math:`\tau` that an inlier stays below, pixels.
        mask: true for the correspondences of a padded batch that count, boolean with shape :math:`(*, N)`.

    Returns:
        scores with shape :math:`(*)`; zero where the sets do not meet, NaN where the ground truth has no inliers.

    Raises:
        TypeError: if a tensor is not floating-point, dtypes differ, or the mask is not boolean.
        ShapeError: if a shape is wrong.
        ValueError: if the points do not pair up, the mask does not fit them, or the threshold is not positive.

    Reference:
        Ranftl and Koltun, as for :func:`inlier_share`.

    Example:
        >>> F_true = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # lines are rows
        >>> F_mat = F_true + torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # one row further down
        >>> points1, points2 = torch.tensor([[5.0, 1.0], [5.0, 2.0]]), torch.tensor([[9.0, 1.5], [9.0, 2.0]])
        >>> f1_score(points1, points2, F_mat, F_true, threshold=1.5)  # precision 1, recall 1/2
        tensor(0.6667)

    """
    inliers = _inliers(points1, points2, F_mat, threshold, mask)
    true = _inliers(points1, points2, F_true, threshold, mask)
    both = 2 * (inliers & true).sum(-1).to(points1.dtype)
    score = both / (inliers.sum(-1) + true.sum(-1))
    return torch.where(true.any(-1), score, torch.nan)


def epipolar_error(
    points1: Tensor,
    points2: Tensor,
    F_mat: Tensor,
    F_true: Tensor,
    threshold: float = 1.0,
    mask: Tensor | None = None,
) -> Tensor:
    r"""Return the mean symmetric epipolar distance of the ground truth's inliers under an estimate, in pixels.

    :math:`\frac{1}{|B|} \sum_{i \in B} d_i(F)` with :math:`B = \{i : d_i(F_{true}) < \tau\}`, whatever threshold the
    other metrics are taken at.

    Args:
        points1: pixels in the first images with shape :math:`(*, N, 2)`.
        points2: pixels in the second images with shape :math:`(*, N, 2)`.
        F_mat: estimated fundamental matrices with shape :math:`(*, 3, 3)`, any scale.
        F_true: true fundamental matrices with shape :math:`(*, 3, 3)`, any scale; NaN where unknown.
        threshold: symmetric epipolar distance :math:`\tau` that an inlier stays below, pixels.
        mask: true for the correspondences of a padded batch that count, boolean with shape :math:`(*, N)`.

    Returns:
        errors in pixels with shape :math:`(*)`; infinite for a failed estimate, NaN where the ground truth has no
        inliers.

    Raises:
        TypeError: if a tensor is not floating-point, dtypes differ, or the mask is not boolean.
        ShapeError: if a shape is wrong.
        ValueError: if the points do not pair up, the mask does not fit them, or the threshold is not positive.

    Reference:
        Ranftl and Koltun, as for :func:`inlier_share`.

    Example:
        >>> F_true = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # lines are rows
        >>> F_mat = F_true + torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # one row further down
        >>> points1, points2 = torch.tensor([[5.0, 1.0], [5.0, 2.0]]), torch.tensor([[9.0, 1.0], [9.0, 9.0]])
        >>> epipolar_error(points1, points2, F_mat, F_true)
        tensor(2.)

    """
    true = _inliers(points1, points2, F_true, threshold, mask)
    distance = _distance(points1, points2, F_mat)
    return torch.where(true, distance, 0.0).sum(-1) / true.sum(-1)


def _distance(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    """Distances in which a matrix of NaN is infinitely far from every point."""
    return symmetric_epipolar_distance(points1, points2, F_mat).nan_to_num(nan=inf, posinf=inf)


def _inliers(points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float, mask: Tensor | None) -> Tensor:
    if not threshold > 0:
        raise ValueError(f"threshold must be positive, got {threshold}")
    inliers = _distance(points1, points2, F_mat) < threshold
    if mask is None:
        return inliers
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        raise TypeError(f"mask must be a boolean tensor, got {getattr(mask, 'dtype', type(mask))}")
    if mask.shape != inliers.shape:
        raise ValueError(f"mask must have shape {[*inliers.shape]}, got {[*mask.shape]}")
    return inliers & mask


class PairedDifference(NamedTuple):
    """How far the mean of one method is above another's on the same samples.

    Attributes:
        mean: mean of ``values - baseline`` over samples.
        low: lower end of its bootstrap interval.
        high: upper end.
        p_value: two-sided p-value of no difference.
    """

    mean: float
    low: float
    high: float
    p_value: float


def paired_bootstrap(
    values: Tensor, baseline: Tensor, groups: Tensor, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> PairedDifference:
    r"""Compare the means of two methods on the same samples by drawing whole image pairs with replacement.

    The p-value is that of the percentile interval which just reaches zero: with :math:`\bar d^*` the mean difference of
    a draw, :math:`p = 2 (1 + \min(|\{\bar d^* \le 0\}|, |\{\bar d^* \ge 0\}|)) / (1 + \text{draws})`, at most one. No
    number of draws makes it smaller than ``2 / (1 + draws)``.

    Args:
        values: one number per sample with shape (S,), or per image pair.
        baseline: the same of the other method with shape (S,).
        groups: index of each sample's image pair with shape (S,), integers.
        level: share of the draws within the interval.
        draws: number of draws.
        seed: seed of the draws.

    Returns:
        the mean difference, its interval of :func:`~kornia_learnnorm.bootstrap_interval`, and the p-value.

    Raises:
        ValueError: if the shapes differ, a difference is not finite (drop such samples of both methods and count them),
            there are fewer than two groups, or ``level`` is not between 0 and 1.

    Reference:
        A. Davison, D. Hinkley, Bootstrap Methods and their Application, 1997, chapters 4 and 5.

    Example:
        >>> values, groups = torch.tensor([0.9, 0.8, 0.7, 0.9]), torch.arange(4)
        >>> paired_bootstrap(values, values - 0.25, groups)
        PairedDifference(mean=0.25, low=0.25, high=0.25, p_value=0.00099...)

    """
    if values.shape != baseline.shape or values.ndim != 1:
        raise ValueError(f"values must be two (S,) tensors, got {[*values.shape]} and {[*baseline.shape]}")
    difference = values.double() - baseline.double()
    bad = int((~difference.isfinite()).sum())
    if bad:
        raise ValueError(f"differences must be finite, got {bad} NaN or infinite ones of {len(difference)}")
    means = bootstrap_means(difference, groups, draws, seed)
    low, high = percentile_interval(means, level)
    fewest = min(int((means <= 0).sum()), int((means >= 0).sum()))
    return PairedDifference(difference.mean().item(), low, high, min(1.0, 2 * (1 + fewest) / (1 + draws)))
