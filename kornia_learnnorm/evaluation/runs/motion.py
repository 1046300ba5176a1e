"""What the cameras did between the images of a pair, from a store's ground truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_learnnorm.data.samples import RATIO
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance

__all__ = ["pair_motions"]

INLIER = 1.0  # pixels


def pair_motions(store: CorrespondenceStore) -> dict[str, NDArray[Any]]:
    """Return figures of each pair's motion; NaN where its ground truth is not known.

    Args:
        store: correspondences with ground truth.

    Returns:
        arrays (P,): ``rotation`` in degrees; ``forward``, the share of the translation along the optical axis,
        :math:`|t_z| / |t|`; ``parallax``, the median displacement of the inliers that the rotation does not explain,
        pixels; ``inliers``, the share of the matches that pass the ratio test and lie within 1 px (symmetric epipolar
        distance) of their ground-truth epipolar lines; and ``names``.

    """
    rows = [_motion(store, pair) for pair in range(len(store))]
    return {
        **{key: np.array([row[key] for row in rows]) for key in ("rotation", "forward", "parallax", "inliers")},
        "names": np.array([f"{first} {second}" for first, second in store.names]),
    }


def _motion(store: CorrespondenceStore, pair: int) -> dict[str, float]:
    unknown = dict.fromkeys(("rotation", "forward", "parallax", "inliers"), float("nan"))
    rows = slice(int(store.offsets[pair]), int(store.offsets[pair + 1]))
    passes = store.ratio[rows] < RATIO
    if not np.isfinite(store.F[pair]).all() or not passes.any():
        return unknown
    x1, x2 = (points[rows][passes].astype(float) for points in (store.points1, store.points2))
    distance = symmetric_epipolar_distance(torch.from_numpy(x1), torch.from_numpy(x2), torch.from_numpy(store.F[pair]))
    near = distance.numpy() < INLIER
    R, t, (K1, K2) = store.R[pair], store.t[pair], store.K[pair]
    if not np.isfinite(R).all() or not near.any():
        return {**unknown, "inliers": float(near.mean())}
    turned = np.c_[x1[near], np.ones(near.sum())] @ (K2 @ R @ np.linalg.inv(K1)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        parallax = np.linalg.norm(x2[near] - turned[:, :2] / turned[:, 2:], axis=1)
    sine, cosine = np.linalg.norm(R - R.T) / 2**0.5, np.trace(R) - 1
    return {
        "rotation": float(np.degrees(np.arctan2(sine, cosine))),
        "forward": float(abs(t[2]) / np.linalg.norm(t)),
        "parallax": float(np.median(parallax)),
        "inliers": float(near.mean()),
    }
