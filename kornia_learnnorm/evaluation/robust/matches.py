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
    """The correspondences of an image pair, in the order in which estimators get them, and its ground truth.

    Attributes:
        points1: pixels in the first image, (N, 2) float64.
        points2: pixels in the second image, (N, 2) float64.
        F_mat: true fundamental matrix, (3, 3).
        K: camera matrices, (2, 3, 3).
        R: true rotation, (3, 3).
        t: true translation, (3,).
        size: (width, height) of both images, (2, 2).
    """

    points1: Tensor
    points2: Tensor
    F_mat: Tensor
    K: Tensor
    R: Tensor
    t: Tensor
    size: NDArray[np.int32]


def even_pairs(total: int, number: int | None) -> list[int]:
    """Return the indices of at most ``number`` evenly spaced image pairs of ``total``; all of them for 0."""
    if number is None or number >= total:
        return list(range(total))
    return [int(place) for place in np.linspace(0, total - 1, number).round()]


def draw_matches(store: CorrespondenceStore, pair: int, protocol: str, seed: int, order: int = 0) -> Matches:
    """Return the correspondences of an image pair; ``order`` is a second seed of their order.

    The protocol ``filtered`` draws at most 1,000 matches that pass the ratio test, ``unfiltered`` takes all.
    """
    rows = np.arange(store.offsets[pair], store.offsets[pair + 1])
    max_ratio = PROTOCOLS[protocol]
    if max_ratio is not None:
        rows = rows[store.ratio[rows] < max_ratio]
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
    results = {
        "inliers": inlier_share(x1, x2, F_mat, threshold),
        "f1": f1_score(x1, x2, F_mat, matches.F_mat, threshold),
        "error": epipolar_error(x1, x2, F_mat, matches.F_mat),
        "rotation_error": rotation_error(pose[0][0], matches.R).nan_to_num(nan=torch.inf),
        "translation_error": translation_error(pose[1][0], matches.t).nan_to_num(nan=torch.inf),
    }
    unknown = bool((rotation_error(matches.R, matches.R) + translation_error(matches.t, matches.t)).isnan())
    results |= dict.fromkeys(("rotation_error", "translation_error"), x1.new_tensor(torch.nan)) if unknown else {}
    return {name: float(value) for name, value in results.items()}
