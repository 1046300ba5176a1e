"""Matches of which no two share a point, so that a point supports a hypothesis once."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["distinct_points"]


def distinct_points(points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return a mask of matches of which no two share a point, chosen greedily from the best to the worst.

    A match is left out if it has the pixel, in view 1 or in view 2, of a better match that is kept. All matches on one
    point count as one: they agree on every epipolar line through it.

    Args:
        points1: finite pixels in the first image with shape :math:`(N, 2)`; points are shared where pixels are equal
            exactly.
        points2: finite pixels in the second image with shape :math:`(N, 2)`.
        weights: optional scores :math:`(N,)`, higher is better; of equal scores, and without any, the first is best.

    Returns:
        mask with shape :math:`(N,)`.

    Example:
        >>> points1 = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        >>> distinct_points(points1, points1[[0, 1, 1]], torch.tensor([0.1, 0.2, 0.3]))
        tensor([ True, False,  True])

    """
    kept = torch.ones_like(points1[:, 0], dtype=torch.bool)
    (number1, labels1), (number2, labels2) = _labels(points1), _labels(points2)
    if number1 == number2 == len(kept):
        return kept
    rows = torch.arange(len(kept)) if weights is None else weights.argsort(descending=True, stable=True).cpu()
    # A loop over numbers: each match depends on all better ones.
    seen1, seen2, left_out = bytearray(len(kept)), bytearray(len(kept)), list[int]()
    for row, a, b in zip(rows.tolist(), labels1.cpu()[rows].tolist(), labels2.cpu()[rows].tolist(), strict=True):
        if seen1[a] or seen2[b]:
            left_out.append(row)
        else:
            seen1[a] = seen2[b] = 1
    kept[left_out] = False
    return kept


def _labels(points: Tensor) -> tuple[int, Tensor]:
    """Return the number of distinct points, and for each point a label below N, equal where points are."""
    total = len(points)
    x, y = points.mT.contiguous() + 0.0  # -0.0 is 0.0
    distinct, labels = torch.unique(x, return_inverse=True)
    if len(distinct) < total:
        labels = labels * total + torch.unique(y, return_inverse=True)[1]
        distinct, labels = torch.unique(labels, return_inverse=True)
    return len(distinct), labels
