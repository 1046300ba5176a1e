"""Matches of which no two share a point, so that a point supports a hypothesis once."""

import torch
from torch import Tensor


def distinct_points(points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return a mask (N,) of matches of which no two share a point, chosen greedily from the best to the worst.

    A match is left out if it has exactly the pixel, in view 1 or in view 2, of a better match that is kept. All matches
    on one point count as one: they agree on every epipolar line through it. Pixels are finite, (N, 2); of equal
    weights (N,), and without any, the first is best.
    """
    kept = torch.ones_like(points1[:, 0], dtype=torch.bool)
    # A complex number for each pixel: equal where both coordinates are, and hashable.
    pixels1, pixels2 = (torch.view_as_complex(points.contiguous()).tolist() for points in (points1, points2))
    if len(set(pixels1)) == len(set(pixels2)) == len(kept):
        return kept
    order = range(len(kept)) if weights is None else weights.argsort(descending=True, stable=True).tolist()
    seen1, seen2, left_out = set[complex](), set[complex](), list[int]()
    for row in order:  # a loop, since each match depends on all better ones
        if pixels1[row] in seen1 or pixels2[row] in seen2:
            left_out.append(row)
        else:
            seen1.add(pixels1[row])
            seen2.add(pixels2[row])
    kept[left_out] = False
    return kept
