"""The matches of image pairs, their ground-truth inliers, and the motion of the cameras between their images."""

from __future__ import annotations

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.runs.results_store import Arrays
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.median import median
from kornia_learnnorm.metrics.poses import rotation_error
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO

MOTIONS = ("rotation", "forward", "parallax", "inliers")
PAIRS = (*MOTIONS, "names")  # arrays in the file of a store's pairs
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


def pair_motions(store: CorrespondenceStore) -> Arrays:
    """Return a description of each pair's motion, arrays (P,); NaN where its ground truth is not known.

    ``rotation`` is in degrees; ``forward`` is the share of the translation along the optical axis, :math:`|t_z| / |t|`;
    ``parallax`` is the median displacement of the inliers that the rotation does not explain, pixels; ``inliers`` is
    the share of ground-truth inliers among the matches that pass the ratio test.
    """
    rows = [_motion(store, pair) for pair in range(len(store))]
    return {
        **{key: np.array([row.get(key, np.nan) for row in rows]) for key in MOTIONS},
        "names": np.array([f"{first} {second}" for first, second in store.names]),
    }


def _motion(store: CorrespondenceStore, pair: int) -> dict[str, float]:
    x1, x2 = pair_matches(store, pair, RATIO)
    F_mat, R, t, K = (torch.from_numpy(part[pair]) for part in (store.F, store.R, store.t, store.K))
    if not bool(F_mat.isfinite().all()) or len(x1) == 0:
        return {}
    near = symmetric_epipolar_distance(x1, x2, F_mat) < INLIER_THRESHOLD
    known = {"inliers": near.double().mean().item()}
    if not bool(R.isfinite().all()) or not bool(near.any()):
        return known
    rotated = convert_points_to_homogeneous(x1[near]) @ (K[1] @ R @ K[0].inverse()).mT
    parallax = (x2[near] - rotated[:, :2] / rotated[:, 2:]).norm(dim=1)
    return known | {
        "rotation": rotation_error(R, torch.eye(3).to(R)).item(),
        "forward": (t[2].abs() / t.norm()).item(),
        "parallax": median(parallax).item(),
    }
