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
    """Return the indices of evenly spaced image pairs.

    Args:
        total: number of pairs.
        number: largest number of indices; None for all.

    Example:
        >>> even_pairs(51, 3), even_pairs(2, None)
        ([0, 25, 50], [0, 1])

    """
    if number is None or number >= total:
        return list(range(total))
    return [int(place) for place in np.linspace(0, total - 1, number).round()]


def draw_matches(store: CorrespondenceStore, pair: int, protocol: str, seed: int, order: int = 0) -> Matches:
    """Return the correspondences of an image pair.

    Args:
        store: correspondences of image pairs.
        pair: index of the pair.
        protocol: ``filtered`` for at most 1,000 random matches that pass the ratio test, ``unfiltered`` for all.
        seed: seed of the random matches and of their order.
        order: second seed of the order.

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
    """Return the metrics of an estimate, NaN where the pair lacks the ground truth.

    Args:
        matches: the correspondences that the estimator got.
        F_mat: estimated matrix (3, 3), float64; zero or NaN for a failure.
        threshold: inlier threshold, pixels.

    Returns:
        ``inliers`` and ``f1`` at the threshold, ``error`` in pixels, and ``rotation_error`` and ``translation_error``
        in degrees. The inliers of the estimate within 1 px decide between the four poses of the matrix.

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
