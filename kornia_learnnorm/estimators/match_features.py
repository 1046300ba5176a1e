r"""What the stages of :class:`~kornia_learnnorm.LearnedEightPoint` read of a set of correspondences.

Features don't change when both images are moved or scaled by one factor. The views come in a canonical order, so that
swapping them changes nothing but which one is called the first.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.geometry.checks import safe_divisor, weighted_mean
from kornia_learnnorm.geometry.distances import line_norms
from kornia_learnnorm.geometry.transforms import affine_transform, transform_fundamental, transform_points

__all__ = ["POINT_FEATURES", "RESIDUAL_FEATURES", "CommonFrame", "masked_median", "match_features", "residual_features"]

POINT_FEATURES, RESIDUAL_FEATURES = 9, 5  # numbers of a correspondence
RESIDUAL_FLOOR = 1e-5  # of the frame's unit, added to distances before their logarithm
MIN_PROBABILITY = 1e-3  # added to the probabilities of inliers in a mean
LINE_FLOOR = 0.3  # of the mean norm of a line's normal, added to each, or points near an epipole outweigh all others


class CommonFrame(NamedTuple):
    """Both views in one frame: the centroid of all points is the origin, their mean distance from it is one.

    Attributes:
        x1: points of the first view, (B, N, 2).
        x2: points of the second view, (B, N, 2).
        T: transform from pixels to the frame, the same for both views, (B, 3, 3).
        inverse: transform from the frame to pixels, (B, 3, 3).
        swapped: whether the canonical order of the views is the second before the first, (B,) bool.
    """

    x1: Tensor
    x2: Tensor
    T: Tensor
    inverse: Tensor
    swapped: Tensor

    @classmethod
    def from_points(cls, points1: Tensor, points2: Tensor, present: Tensor | None) -> CommonFrame:
        """Return the frame of correspondences (B, N, 2); ``present`` (B, N) is one for those that count, zero else.

        The view whose points spread less comes first: a camera that moves forward sees them spread.
        """
        mean1, mean2 = weighted_mean(points1, present), weighted_mean(points2, present)
        origin = (mean1 + mean2) / 2
        radius = (_mean_distance(points1, origin, present) + _mean_distance(points2, origin, present)) / 2
        radius = safe_divisor(radius)[:, None]
        eye = torch.eye(2).to(points1)
        T = affine_transform(eye / radius, origin)
        inverse = affine_transform(eye * radius, -origin / radius[:, 0])
        spreads = (_mean_distance(points1, mean1, present), _mean_distance(points2, mean2, present))
        swapped = spreads[0].detach() > spreads[1].detach()
        return cls(transform_points(points1, T), transform_points(points2, T), T, inverse, swapped[:, 0])


def _mean_distance(points: Tensor, origin: Tensor, present: Tensor | None) -> Tensor:
    """Return the mean distance (B, 1) of the points (B, N, 2) that count from an origin (B, 2)."""
    return weighted_mean((points - origin[:, None]).norm(dim=-1, keepdim=True), present)


def match_features(frame: CommonFrame, scores: Tensor | None, present: Tensor | None) -> Tensor:
    r"""Return the features of correspondences before any matrix is known, :math:`(B, N, 9)`.

    Both points, their displacement from the median displacement over the median deviation, the score and whether there
    is one, and the number of correspondences.
    """
    swapped = frame.swapped[:, None, None]
    first, second = torch.where(swapped, frame.x2, frame.x1), torch.where(swapped, frame.x1, frame.x2)
    shift = second - first
    shift = shift - masked_median(shift, present)
    deviation = masked_median(shift.norm(dim=-1, keepdim=True), present)
    relative = torch.asinh(shift / safe_divisor(deviation))
    if scores is None:
        score = torch.zeros_like(relative)
    else:
        score = torch.stack([scores.to(first), torch.ones_like(first[..., 0])], -1)
    number = torch.full_like(first[..., :1], first.shape[1]) if present is None else present.sum(1)[:, None, None]
    number = (number.expand_as(first[..., :1]) / 8).clamp(min=1.0).log()
    return torch.cat([torch.asinh(first), torch.asinh(second), relative, score, number], -1)


def residual_features(
    frame: CommonFrame, F_mat: Tensor, logits: Tensor, present: Tensor | None
) -> tuple[Tensor, Tensor]:
    r"""Return the features of correspondences under a matrix, :math:`(B, N, 5)`, and gradient factors, :math:`(B, N)`.

    The features are the Sampson distance, its ratios to the median and to the geometric mean over the inliers, and the
    gradient factor, all as logarithms, and the logit before. The mean is weighted by the probabilities of the logits.

    The gradient factor :math:`1 / (\|(F x_1)_{1:2}\|^2 + \|(F^\top x_2)_{1:2}\|^2)` turns squared algebraic residuals
    into squared Sampson distances; its median is one.
    """
    x1, x2 = convert_points_to_homogeneous(frame.x1), convert_points_to_homogeneous(frame.x2)
    F = transform_fundamental(F_mat, frame.inverse, frame.inverse)
    F = F / torch.linalg.matrix_norm(F, keepdim=True)
    norm1, norm2 = line_norms(x1, x2, F, present, floor=LINE_FLOOR)
    factor = 1 / (norm1.square() + norm2.square())
    residual = (x2 * (x1 @ F.mT)).sum(-1).square() * factor
    distance = (residual + RESIDUAL_FLOOR**2).log()[..., None] / 2
    factor = factor / masked_median(factor[..., None], present)[..., 0]
    relative = distance - masked_median(distance, present)
    probability = logits.to(F).sigmoid() + MIN_PROBABILITY
    among_inliers = weighted_mean(distance, probability if present is None else probability * present)[:, None]
    features = [distance / 2 + 3, relative / 2, (distance - among_inliers) / 2, factor.log()[..., None]]
    return torch.cat([*features, logits.to(F)[..., None] / 4], -1), factor


def masked_median(values: Tensor, present: Tensor | None) -> Tensor:
    """Return the lower median over the correspondences that count, :math:`(B, N, C) -> (B, 1, C)`."""
    if present is None:
        return values.median(1, keepdim=True).values
    held = torch.where(present[..., None] > 0, values, torch.inf).sort(1).values
    middle = ((present.sum(1).long() - 1).clamp(min=0) // 2)[:, None, None].expand(-1, 1, values.shape[-1])
    median = held.gather(1, middle)
    return torch.where(median.isfinite(), median, 0.0)
