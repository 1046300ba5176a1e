"""The correspondences of image pairs as robust estimators get them, and what an estimate is worth on them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.samples import RATIO
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.pairs import epipolar_error, f1_score, inlier_share
from kornia_learnnorm.metrics.poses import rotation_error, translation_error

__all__ = ["Matches", "draw_matches", "even_pairs", "measure"]

MOST_FILTERED = 1000  # matches of a pair that passed the ratio test, as in Fan et al.
VOTING = 1.0  # pixels: inliers of an estimate that vote for its pose


class Matches(NamedTuple):
    """The correspondences of an image pair in the order in which estimators get them, and its ground truth.

    Attributes:
        points1: pixels in the first image, (N, 2) float64.
        points2: pixels in the second image, (N, 2) float64.
        F_mat: true matrix, (3, 3).
        K: cameras, (2, 3, 3).
        R: rotation, (3, 3).
        t: translation, (3,).
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
        total: how many there are.
        number: how many to take, at most; None for all.

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
        protocol: ``filtered``, those that pass the ratio test and at most 1,000 of them, at random, or ``unfiltered``,
            all.
        seed: seed of what is kept.
        order: further seed, of the order alone.

    """
    rows = np.arange(store.offsets[pair], store.offsets[pair + 1])
    if protocol == "filtered":
        rows = rows[store.ratio[rows] < RATIO]
        rows = np.random.default_rng([seed, pair]).permutation(rows)[:MOST_FILTERED]
    rows = np.random.default_rng([seed, pair, order]).permutation(rows)
    points1, points2 = (torch.from_numpy(points[rows]).double() for points in (store.points1, store.points2))
    F_mat, K, R, t = (torch.from_numpy(part[pair]) for part in (store.F, store.K, store.R, store.t))
    return Matches(points1, points2, F_mat, K, R, t, store.image_size[pair])


def measure(matches: Matches, F_mat: Tensor, threshold: float) -> dict[str, float]:
    """Return the figures of an estimate, NaN where the pair has no ground truth for them.

    Args:
        matches: the correspondences that it was made from.
        F_mat: estimated matrix (3, 3), float64; zero or NaN: it failed.
        threshold: of an inlier, pixels.

    Returns:
        ``inliers`` and ``f1`` at the threshold, ``error`` in pixels, ``rotation_error`` and ``translation_error`` in
        degrees, of the pose for which the estimate's inliers within 1 px vote.

    """
    x1, x2 = matches.points1, matches.points2
    near = symmetric_epipolar_distance(x1, x2, F_mat) < VOTING
    pose = relative_pose(F_mat[None], matches.K[:1], matches.K[1:], x1[None], x2[None], near[None])
    figures = {
        "inliers": inlier_share(x1, x2, F_mat, threshold),
        "f1": f1_score(x1, x2, F_mat, matches.F_mat, threshold),
        "error": epipolar_error(x1, x2, F_mat, matches.F_mat),
        "rotation_error": rotation_error(pose[0][0], matches.R).nan_to_num(nan=torch.inf),
        "translation_error": translation_error(pose[1][0], matches.t).nan_to_num(nan=torch.inf),
    }
    unknown = bool((rotation_error(matches.R, matches.R) + translation_error(matches.t, matches.t)).isnan())
    figures |= dict.fromkeys(("rotation_error", "translation_error"), x1.new_tensor(torch.nan)) if unknown else {}
    return {name: float(value) for name, value in figures.items()}
