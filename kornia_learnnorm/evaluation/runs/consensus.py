"""How many of a pair's matches agree with the matrix of each of its samples."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.runs.pairs import pair_matches
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.protocol import THRESHOLDS

__all__ = ["consensus"]


def consensus(F_mat: Tensor, pair: Tensor, store: CorrespondenceStore, max_ratio: float | None) -> dict[str, Tensor]:
    """Compute share of inliers and F1 of many matrices, each over all matches of its image pair.

    The values are those of :func:`~kornia_learnnorm.metrics.pairs.inlier_share` and
    :func:`~kornia_learnnorm.metrics.pairs.f1_score`, with the distances computed once for both and for all of
    :data:`~kornia_learnnorm.protocol.THRESHOLDS`.

    Args:
        F_mat: estimated matrices with shape (S, 3, 3), float64.
        pair: image pair of each with shape (S,), int64.
        store: the matches and the true matrices.
        max_ratio: only matches with Lowe's ratio below count; None for all.

    Returns:
        ``inliers`` and ``f1`` with shape (S, thresholds); F1 is NaN where the ground truth has no inliers.

    """
    inliers = F_mat.new_full((len(F_mat), len(THRESHOLDS)), torch.nan)
    f1 = inliers.clone()
    for index in torch.unique(pair).tolist():
        rows = torch.nonzero(pair == index).flatten()
        points1, points2 = pair_matches(store, index, max_ratio)
        true = _within(points1[None], points2[None], torch.from_numpy(store.F[index : index + 1]))
        number = len(rows), -1, -1
        found = _within(points1.expand(*number), points2.expand(*number), F_mat[rows])
        both, either = (found & true).sum(-1), found.sum(-1) + true.sum(-1)
        inliers[rows] = found.double().mean(-1)
        f1[rows] = torch.where(true.any(-1), (2 * both).double() / either, torch.nan)
    return {"inliers": inliers, "f1": f1}


def _within(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    """Return which points lie within each threshold, (S, thresholds, N); none do under a matrix of NaN."""
    distance = symmetric_epipolar_distance(points1, points2, F_mat).nan_to_num(nan=torch.inf)
    return distance[:, None] < distance.new_tensor(THRESHOLDS)[:, None]
