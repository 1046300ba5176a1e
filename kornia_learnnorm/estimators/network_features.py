r"""Input features of the networks of :class:`~kornia_learnnorm.LearnedEightPoint` and the other learned layers.

Features are invariant to a translation and a scale that are common to both images. The views are put in a canonical
order, so that swapping them has no effect, and the second is rotated upright with respect to the first.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.geometry.checks import safe_divisor, weighted_mean
from kornia_learnnorm.models.two_view_model import TwoViewModel

POINT_FEATURES, RESIDUAL_FEATURES = 9, 5  # numbers of a correspondence
RESIDUAL_FLOOR = 1e-5  # of the frame's unit, added to distances before their logarithm
DEVIATION_FLOOR = 1e-5  # of the frame's unit: below it, deviations from an exact shift of the image are rounding
# Of a squared length: the second derivative of a root at zero is not finite.
MIN_SQUARE = {torch.float32: 1e-24, torch.float64: 1e-200}
MIN_PROBABILITY = 1e-3  # added to the probabilities of inliers in a mean
FAR_FROM_CHANCE = 1.5  # correlations of rotated views, in root mean squares of those of random matches


class CommonFrame(NamedTuple):
    """Both views in one frame: the centroid of all points is the origin, their mean distance from it is one."""

    x1: Tensor  # points, (B, N, 2)
    x2: Tensor
    T: Tensor  # from pixels to the frame, the same for both views, (B, 3, 3)
    inverse: Tensor  # from the frame to pixels, (B, 3, 3)
    swapped: Tensor  # whether the canonical order of the views is the second before the first, (B,) bool

    @classmethod
    def from_points(cls, points1: Tensor, points2: Tensor, present: Tensor | None) -> "CommonFrame":
        """Return the frame of correspondences (B, N, 2); ``present`` (B, N) is one for those that count, zero else.

        The view whose points spread less comes first: a camera that moves forward sees them spread.
        """
        points = torch.stack([points1, points2], 1)
        share = None if present is None else (present / safe_divisor(present.sum(-1, keepdim=True)))[:, None]
        mean = points.mean(2) if share is None else (points * share[..., None]).sum(2)
        origin = mean.mean(1)
        centred = points - origin[:, None, None]
        squares = torch.stack([centred, points - mean[:, :, None]]).square().sum(-1)
        distances = squares.clamp(min=MIN_SQUARE[squares.dtype]).sqrt()
        distances = distances.mean(-1) if share is None else (distances * share).sum(-1)
        radius = distances[0].mean(1)
        radius = radius + (radius == 0)
        one, zero = torch.ones_like(radius), torch.zeros_like(radius)
        x, y = origin.unbind(-1)
        entries = [one / radius, zero, -x / radius, zero, one / radius, -y / radius, zero, zero, one]
        inverse = [radius, zero, x, zero, radius, y, zero, zero, one]
        T, back = torch.unflatten(torch.stack([torch.stack(entries, -1), torch.stack(inverse, -1)]), -1, (3, 3))
        x1, x2 = (centred / radius[:, None, None, None]).unbind(1)
        return cls(x1, x2, T, back, distances[1, :, 0].detach() > distances[1, :, 1].detach())


def upright_rotation(frame: CommonFrame, present: Tensor | None) -> Tensor:
    """Return the rotations (B, 3, 3) that turn the second view, in canonical order, upright relative to the first.

    The least-squares rotation between two sets of points has the angle of their correlation as complex numbers (B.
    Horn, Closed-form solution of absolute orientation using unit quaternions, 1987). Views that are rotated by up
    to 45 degrees count as upright, and so do those whose correlation may be that of random matches.
    """
    points = torch.stack([frame.x1, frame.x2], 1).detach()
    points = points - weighted_mean(points, None if present is None else present[:, None])[:, :, None]
    points = points if present is None else points * present[:, None, :, None]
    first, second = points.unbind(1)
    C = first.mT @ second
    along, across = C[:, 0, 0] + C[:, 1, 1], C[:, 0, 1] - C[:, 1, 0]
    length, by_chance = torch.hypot(along, across), points.square().sum(-1).prod(1).sum(1).sqrt()
    rotated = (along < across.abs()) & (length > FAR_FROM_CHANCE * by_chance)
    cos, sin = torch.where(rotated, along / length, 1.0), torch.where(rotated, across / length, 0.0)
    sin = torch.where(frame.swapped, -sin, sin)
    one, zero = torch.ones_like(cos), torch.zeros_like(cos)
    return torch.unflatten(torch.stack([cos, sin, zero, -sin, cos, zero, zero, zero, one], -1), -1, (3, 3))


def match_features(frame: CommonFrame, upright: Tensor, scores: Tensor | None, present: Tensor | None) -> Tensor:
    r"""Return the features of correspondences before any matrix is known, :math:`(B, N, 9)`.

    They are both points, their displacement minus the median one, over the median deviation, the score and whether
    there is one, and the number of correspondences. The rotations ``upright`` turn the second view about its mean.
    """
    swapped = frame.swapped[:, None, None]
    first, second = torch.where(swapped, frame.x2, frame.x1), torch.where(swapped, frame.x1, frame.x2)
    centre = weighted_mean(second, present)[:, None]
    second = second + (second - centre) @ (upright[:, :2, :2].mT - torch.eye(2).to(upright))
    shift = second - first
    shift = shift - masked_median(shift, present)
    length = shift.square().sum(-1, keepdim=True).clamp(min=MIN_SQUARE[shift.dtype]).sqrt()
    deviation = masked_median(length, present)
    relative = torch.asinh(shift / deviation.clamp(min=DEVIATION_FLOOR))
    if scores is None:
        score = torch.zeros_like(relative)
    else:
        score = torch.stack([scores.to(first), torch.ones_like(first[..., 0])], -1)
    number = torch.full_like(first[..., :1], first.shape[1]) if present is None else present.sum(1)[:, None, None]
    number = (number.expand_as(first[..., :1]) / 8).clamp(min=1.0).log()
    return torch.cat([torch.asinh(first), torch.asinh(second), relative, score, number], -1)


def residual_features(
    model: TwoViewModel, x1: Tensor, x2: Tensor, M: Tensor, logits: Tensor, present: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the features of correspondences under a matrix, :math:`(B, N, 5)`, and gradient factors, :math:`(B, N)`.

    The features are the distance, its ratios to the median and to the geometric mean over the inliers, and the gradient
    factor, all as logarithms, and the previous logit. The mean is weighted by the probabilities of the logits.
    The gradient factor turns squared algebraic residuals into squared distances; its median is one.

    Points are homogeneous, :math:`(B, 3, N)`, and matrices :math:`(B, 3, 3)`, both in the frame; logits :math:`(B, N)`
    are those of the stage before. ``present`` is one for correspondences that count, zero for others; None: all.
    """
    squares, factor = model.robust_distance(M / torch.linalg.matrix_norm(M, keepdim=True), x1, x2, present)
    distance = (squares + RESIDUAL_FLOOR**2).log()[..., None] / 2
    factor = factor / masked_median(factor[..., None], present)[..., 0]
    relative = distance - masked_median(distance, present)
    probability = logits.to(M).sigmoid() + MIN_PROBABILITY
    among_inliers = weighted_mean(distance, probability if present is None else probability * present)[:, None]
    features = [distance / 2 + 3, relative / 2, (distance - among_inliers) / 2, factor.log()[..., None]]
    return torch.cat([*features, logits.to(M)[..., None] / 4], -1), factor


def masked_median(values: Tensor, present: Tensor | None) -> Tensor:
    """Return the lower median over the correspondences that count, :math:`(B, N, C) -> (B, 1, C)`."""
    if present is None:
        return values.median(1, keepdim=True).values
    held = torch.where(present[..., None] > 0, values, torch.inf).sort(1).values
    middle = ((present.sum(1).long() - 1).clamp(min=0) // 2)[:, None, None].expand(-1, 1, values.shape[-1])
    median = held.gather(1, middle)
    return torch.where(median.isfinite(), median, 0.0)
