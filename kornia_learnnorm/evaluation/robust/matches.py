"""The correspondences of image pairs that robust estimators get, and metrics of the estimates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.pairs import epipolar_error, f1_score, inlier_share
from kornia_learnnorm.metrics.poses import rotation_error, translation_error
from kornia_learnnorm.protocol import INLIER_THRESHOLD, MAX_FILTERED, PROTOCOLS

__all__ = ["Matches", "draw_matches", "even_pairs", "measure"]


class Matches(NamedTuple):
    """The correspondences of an image pair, in the order in which estimators get them, and its ground truth."""

    points1: Tensor  # pixels in the first image, (N, 2) float64
    points2: Tensor  # pixels in the second image, (N, 2) float64
    F_mat: Tensor  # true fundamental matrix, (3, 3)
    K: Tensor  # camera matrices, (2, 3, 3)
    R: Tensor  # true rotation, (3, 3)
    t: Tensor  # true translation, (3,)
    size: NDArray[np.int32]  # (width, height) of both images, (2, 2)


def even_pairs(total: int, number: int) -> list[int]:
    """Return the indices of at most ``number`` evenly spaced image pairs of ``total``; all of them for 0."""
    return [int(place) for place in np.linspace(0, total - 1, min(number or total, total)).round()]


def draw_matches(store: CorrespondenceStore, pair: int, protocol: str, seed: int, order: int = 0) -> Matches:
    """Return the correspondences of an image pair; ``order`` is a second seed of their order.

    The protocol ``filtered`` draws at most 1,000 matches that pass the ratio test, ``unfiltered`` takes all.
    """
    rows = store.rows(pair, PROTOCOLS[protocol])
    if protocol == "filtered":
        rows = np.random.default_rng([seed, pair]).permutation(rows)[:MAX_FILTERED]
    rows = np.random.default_rng([seed, pair, order]).permutation(rows)
    points1, points2 = (torch.from_numpy(points[rows]).double() for points in (store.points1, store.points2))
    F_mat, K, R, t = (torch.from_numpy(part[pair]) for part in (store.F, store.K, store.R, store.t))
    return Matches(points1, points2, F_mat, K, R, t, store.image_size[pair])


def measure(matches: Matches, F_mat: Tensor, threshold: float) -> dict[str, float]:
    """Return ``inliers``, ``f1``, ``error`` (px), ``rotation_error`` and ``translation_error`` (degrees) of a matrix.

    They are NaN where the pair lacks the ground truth. A failed estimate is zero or NaN. The inliers of the estimate
    within 1 px decide between the four poses of the matrix.
    """
    x1, x2 = matches.points1, matches.points2
    near = symmetric_epipolar_distance(x1, x2, F_mat) < INLIER_THRESHOLD
    pose = relative_pose(F_mat[None], matches.K[:1], matches.K[1:], x1[None], x2[None], near[None])
    known = bool((rotation_error(matches.R, matches.R) + translation_error(matches.t, matches.t)).isfinite())
    found = rotation_error(pose[0][0], matches.R), translation_error(pose[1][0], matches.t)
    angles = [angle.nan_to_num(nan=torch.inf) if known else angle * torch.nan for angle in found]
    results = {
        "inliers": inlier_share(x1, x2, F_mat, threshold),
        "f1": f1_score(x1, x2, F_mat, matches.F_mat, threshold),
        "error": epipolar_error(x1, x2, F_mat, matches.F_mat),
        "rotation_error": angles[0],
        "translation_error": angles[1],
    }
    return {name: float(value) for name, value in results.items()}
