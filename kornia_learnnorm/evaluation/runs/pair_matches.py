"""The matches of image pairs and their ground-truth inliers."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.median import median
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO

MIN_INLIERS = 16  # a pair with fewer has no ground-truth inliers to measure with
MAX_INLIERS = 200  # of a pair, the first in the store's random order


def pair_matches(store: CorrespondenceStore, pair: int, max_ratio: float | None) -> tuple[Tensor, Tensor]:
    """Return the matches of an image pair in both views below Lowe's ratio, pixels, (M, 2) float64 each."""
    points1, points2, _ = store.matches(pair, max_ratio)
    return torch.from_numpy(points1).double(), torch.from_numpy(points2).double()


def ground_truth_inliers(store: CorrespondenceStore) -> Tensor:
    """Return each pair's matches that pass the ratio test and lie within 1 px of their ground-truth epipolar lines.

    They are points (x1, y1, x2, y2), (P, 200, 4) float64, padded with NaN; all NaN for a pair with fewer than 16.
    """
    result = torch.full((len(store), MAX_INLIERS, 4), torch.nan, dtype=torch.float64)
    for pair, F_mat in enumerate(torch.from_numpy(store.F)):
        x1, x2 = pair_matches(store, pair, RATIO)
        near = symmetric_epipolar_distance(x1, x2, F_mat) < INLIER_THRESHOLD  # none if F_mat is NaN, not known
        points = torch.cat([x1, x2], -1)[near][:MAX_INLIERS]
        if len(points) >= MIN_INLIERS:
            result[pair, : len(points)] = points
    return result


def median_distance(points: Tensor, F_mat: Tensor) -> Tensor:
    """Return the median symmetric epipolar distance (S,) of sets (S, N, 4), pixels; rows of NaN are left out."""
    known = points.nan_to_num()
    distance = symmetric_epipolar_distance(known[..., :2], known[..., 2:], F_mat)
    distance[points.isnan().any(-1)] = torch.nan
    return median(distance)
