r"""Summaries of pose errors over image pairs, in each of which a failure, an infinite error, counts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_learnnorm.geometry.checks import solve_dtype

__all__ = ["mean_average_accuracy", "pose_auc"]


def pose_auc(errors: Tensor, thresholds: Sequence[float] = (5, 10, 20)) -> tuple[float, ...]:
    r"""Return the area under the recall curve of pose errors up to each threshold, as a share.

    The curve joins (0, 0) and :math:`(e_i, i / P)` of the sorted errors below the threshold :math:`\tau` by straight
    lines and is level from the last to :math:`\tau`. Its trapezoids add up to
    :math:`(\sum_{e_i < \tau} (\tau - e_i) + \max_{e_i < \tau} e_i / 2) / (P \tau)`.

    Args:
        errors: one pose error per image pair with shape :math:`(P,)`, degrees; infinite for a failure.
        thresholds: largest errors, degrees.

    Returns:
        areas from 0 to 1, one per threshold.

    Raises:
        ValueError: if there are no errors, one is NaN or negative, or a threshold is not positive.

    Reference:
        P.-E. Sarlin et al., SuperGlue: Learning Feature Matching with Graph Neural Networks, CVPR 2020.

    Example:
        >>> pose_auc(torch.tensor([0.0, 2.0, torch.inf]), thresholds=(4, 8))
        (0.583..., 0.625)

    """
    errors = _checked(errors)
    return tuple(_area(errors, threshold) for threshold in thresholds)


def _area(errors: Tensor, threshold: float) -> float:
    if not threshold > 0:
        raise ValueError(f"a threshold must be positive, got {threshold}")
    below = errors[errors < threshold]
    if len(below) == 0:
        return 0.0
    return ((threshold - below).sum() + below.max() / 2).item() / (len(errors) * threshold)


def mean_average_accuracy(errors: Tensor, limit: int = 10) -> float:
    r"""Return the share of image pairs with a pose error below 1, 2, ... degrees, averaged: mAA(10).

    :math:`\frac{1}{L} \sum_{k=1}^{L} |\{i : e_i < k\}| / P`, with the larger of rotation and translation error as
    :math:`e_i`, see :func:`~kornia_learnnorm.metrics.poses.pose_error`.

    Args:
        errors: one pose error per image pair with shape :math:`(P,)`, degrees; infinite for a failure.
        limit: the last threshold :math:`L`, whole degrees.

    Returns:
        the average, from 0 to 1.

    Raises:
        ValueError: if there are no errors, one is NaN or negative, or the limit is below one.

    Reference:
        Y. Jin et al., Image Matching across Wide Baselines: From Paper to Practice, IJCV 2021. Its histogram also
        counts an error of exactly 10 degrees.

    Example:
        >>> mean_average_accuracy(torch.tensor([0.5, 5.5, torch.inf]))
        0.5

    """
    errors = _checked(errors)
    if limit < 1:
        raise ValueError(f"limit must be one degree or more, got {limit}")
    degrees = torch.arange(1, limit + 1, device=errors.device)
    return (errors[:, None] < degrees).to(errors.dtype).mean().item()


def _checked(errors: Tensor) -> Tensor:
    if errors.ndim != 1 or len(errors) == 0:
        raise ValueError(f"errors must be a (P,) tensor of at least one pair, got shape {[*errors.shape]}")
    bad = int((~(errors >= 0)).sum())
    if bad:
        raise ValueError(f"errors must be zero or more, infinite for a failure, got {bad} NaN or negative ones")
    return errors.to(solve_dtype(errors.device))
