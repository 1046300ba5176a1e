r"""Errors of relative poses and their summaries over image pairs: AUC and mean average accuracy.

A pose is :math:`X_2 = R X_1 + t`; the length of :math:`t` is unknown. Errors are angles in degrees: infinite for a
failed estimate, which counts in the summaries, NaN where the ground truth is unknown.
"""

from collections.abc import Sequence
from math import inf

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.metrics import angle_error_mat, angle_error_vec, auc_from_errors
from torch import Tensor

from kornia_learnnorm.geometry.checks import solve_dtype


def pose_error(R: Tensor, t: Tensor, R_true: Tensor, t_true: Tensor) -> Tensor:
    r"""Return the larger of rotation and translation error :math:`(*)`, degrees.

    Rotations have shape :math:`(*, 3, 3)`, translations :math:`(*, 3)` and any length. The error is infinite where the
    estimate is NaN or has no direction, NaN where the truth is or has none. ShapeError if a shape is wrong.

    Opposite translations are 180 degrees apart, as in NG-RANSAC: the points in front of the cameras decide the sign.
    SuperGlue's evaluation and the Image Matching Benchmark leave it open.

    Example:
        >>> R, t = torch.eye(3).repeat(2, 1, 1), torch.tensor([[0.0, 0.0, 1.0], [torch.nan, 0.0, 1.0]])
        >>> pose_error(R, t, torch.eye(3), torch.tensor([0.0, 1.0, 1.0]))
        tensor([45., inf])
    """
    for value, shape in ((R, "33"), (R_true, "33"), (t, "3"), (t_true, "3")):
        KORNIA_CHECK_SHAPE(value, ["*", *shape])
    R, t = R.expand_as(R + R_true), t.expand_as(t + t_true)  # Kornia's functions take equal shapes and dtypes
    R_true, t_true = R_true.expand_as(R).to(R), t_true.expand_as(t).to(t)
    error = torch.maximum(angle_error_mat(R, R_true), angle_error_vec(t, t_true))
    unknown = (angle_error_mat(R_true, R_true) + angle_error_vec(t_true, t_true)).isnan()
    return torch.where(unknown, torch.nan, error.nan_to_num(nan=inf))


def pose_auc(errors: Tensor, thresholds: Sequence[float] = (5, 10, 20)) -> tuple[float, ...]:
    r"""Return the area under the recall curve of pose errors (P,), degrees, up to each threshold, as a share.

    The curve joins (0, 0) and :math:`(e_i, i / P)` of the sorted errors below the threshold :math:`\tau` by straight
    lines and is level from the last to :math:`\tau`. A failure has an infinite error.

    Reference:
        P.-E. Sarlin et al., SuperGlue: Learning Feature Matching with Graph Neural Networks, CVPR 2020.
    """
    if not all(threshold > 0 for threshold in thresholds):
        raise ValueError(f"thresholds must be positive, got {[*thresholds]}")
    areas = auc_from_errors(_checked(errors), [*map(float, thresholds)])
    return tuple(areas[float(threshold)] / 100 for threshold in thresholds)


def mean_average_accuracy(errors: Tensor) -> float:
    """Return the share of pose errors (P,) below 1, 2, ..., 10 degrees, averaged: mAA(10).

    Reference:
        Y. Jin et al., Image Matching across Wide Baselines: From Paper to Practice, IJCV 2021. Its histogram also
        counts an error of exactly 10 degrees.
    """
    errors = _checked(errors)
    return (errors[:, None] < torch.arange(1, 11, device=errors.device)).to(errors.dtype).mean().item()


def _checked(errors: Tensor) -> Tensor:
    if errors.ndim != 1 or len(errors) == 0:
        raise ValueError(f"errors must be a (P,) tensor of at least one pair, got shape {[*errors.shape]}")
    if bad := int((~(errors >= 0)).sum()):
        raise ValueError(f"errors must be zero or more, infinite for a failure, got {bad} NaN or negative ones")
    return errors.to(solve_dtype(errors.device))
