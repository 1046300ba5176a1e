"""The motion of the cameras between the images of a pair, from a store's ground truth."""

from __future__ import annotations

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.evaluation.runs.arrays import Arrays
from kornia_learnnorm.evaluation.runs.pairs import pair_matches
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.summary import median
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO

__all__ = ["pair_motions"]

QUANTITIES = ("rotation", "forward", "parallax", "inliers")


def pair_motions(store: CorrespondenceStore) -> Arrays:
    """Return a description of each pair's motion, arrays (P,); NaN where its ground truth is not known.

    ``rotation`` is in degrees; ``forward`` is the share of the translation along the optical axis, :math:`|t_z| / |t|`;
    ``parallax`` is the median displacement of the inliers that the rotation does not explain, pixels; ``inliers`` is
    the share of ground-truth inliers among the matches that pass the ratio test.
    """
    rows = [_motion(store, pair) for pair in range(len(store))]
    return {
        **{key: np.array([row.get(key, np.nan) for row in rows]) for key in QUANTITIES},
        "names": np.array([f"{first} {second}" for first, second in store.names]),
    }


def _motion(store: CorrespondenceStore, pair: int) -> dict[str, float]:
    """Return what is known of a pair's motion."""
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
    sine, cosine = (R - R.mT).norm() / 2**0.5, R.trace() - 1
    return known | {
        "rotation": torch.atan2(sine, cosine).rad2deg().item(),
        "forward": (t[2].abs() / t.norm()).item(),
        "parallax": median(parallax).item(),
    }
