r"""The homography of a scene that is mostly a plane, the parallax of the rest, and the matrix of both.

With the homography :math:`H` of the plane, two matches off the plane determine the epipole :math:`e_2`, since the line
through :math:`H x_1` and :math:`x_2` passes through it, and :math:`F = [e_2]_\times H`.

Points are pixels (N, 2) in float64, matrices (3, 3), and thresholds pixels.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import cross_product_matrix
from torch import Tensor

from kornia_learnnorm.data.images import import_cv2
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.local_optimization import FINAL_LOSS_SCALE
from kornia_learnnorm.ransac.scoring import PairScorer

__all__ = ["find_homography", "fit_plane_and_parallax", "parallax", "parallax_evidence"]

OFF_PLANE = 2.0  # thresholds; a match that the homography misses by more lies off the plane
MAX_SAMPLES = 1000  # pairs of matches off the plane that are tried
MIN_PARALLAX_INLIERS = 3  # matches off the plane that a matrix must have to be more than a choice of two


def find_homography(points1: Tensor, points2: Tensor, threshold: float) -> Tensor | None:
    """Return the homography that explains most matches within a threshold, by OpenCV's MAGSAC, or None."""
    cv2 = import_cv2()
    try:
        H = cv2.findHomography(points1.numpy(), points2.numpy(), cv2.USAC_MAGSAC, threshold)[0]
    except cv2.error:  # OpenCV 4 raises when too few points are left to sample from
        H = None
    return None if H is None or not np.isfinite(H).all() else torch.from_numpy(H).double()


def parallax(points1: Tensor, points2: Tensor, H: Tensor) -> Tensor:
    """Return the distances (N,) of points2 from where a homography moves points1, pixels."""
    moved = convert_points_to_homogeneous(points1) @ H.mT
    distance: Tensor = (moved[:, :2] / moved[:, 2:] - points2).norm(dim=-1)
    return distance.nan_to_num(nan=math.inf)


def parallax_evidence(distance: Tensor, inliers: Tensor, threshold: float) -> float:
    r"""Return log10 of the expected number of epipoles with as many inliers off the plane among random matches.

    The epipolar line of a match off the plane runs through :math:`H x_1` and the epipole. A random match at the
    distance :math:`r` from :math:`H x_1` lies within :math:`\tau` of this line with probability
    :math:`\frac{2}{\pi} \arcsin(\tau / r)`. Two matches determine an epipole; the others are evidence for it.

    Small is strong evidence; where fewer than three matches off the plane are inliers, there is none: it is infinite.

    Args:
        distance: of the matches from where the homography moves them, see :func:`parallax`, (N,).
        inliers: mask of the inliers of the matrix, (N,).
        threshold: largest distance :math:`\tau` of an inlier from its epipolar line.

    Reference:
        L. Moisan, B. Stival, A probabilistic criterion to detect rigid point matches between two images and estimate
        the fundamental matrix, IJCV 2004.

    """
    off = distance > OFF_PLANE * threshold
    number, agree = int(off.sum()), int((off & inliers).sum())
    if agree < MIN_PARALLAX_INLIERS:
        return math.inf
    chance = 2 / math.pi * (threshold / distance[off]).clamp(max=1.0).asin()
    expected, excess = float(chance.mean()) * (number - 2), agree - 2
    if excess <= expected:
        return math.inf
    tail = excess - expected - excess * math.log(excess / max(expected, 1e-9))  # Chernoff's bound
    return math.log10(number * (number - 1) / 2) + tail / math.log(10)


def fit_plane_and_parallax(points1: Tensor, points2: Tensor, H: Tensor, threshold: float, seed: int) -> Tensor | None:
    """Return the fundamental matrix of a homography and an epipole that most matches agree with, refined on all.

    It has rank 2 and unit Frobenius norm; None where fewer than three matches are off the plane. The threshold is the
    largest Sampson distance of an inlier; the seed draws the pairs of matches off the plane.

    Reference:
        O. Chum, T. Werner, J. Matas, Two-view geometry estimation unaffected by a dominant plane, CVPR 2005.

    """
    off = (parallax(points1, points2, H) > OFF_PLANE * threshold).nonzero()[:, 0]
    if len(off) < MIN_PARALLAX_INLIERS:
        return None
    generator = torch.Generator().manual_seed(seed)
    first, second = torch.triu_indices(len(off), len(off), 1)
    chosen = torch.randperm(len(first), generator=generator)[:MAX_SAMPLES]
    x1, x2 = convert_points_to_homogeneous(points1), convert_points_to_homogeneous(points2)
    lines = torch.linalg.cross(x1[off] @ H.mT, x2[off])
    epipole = torch.linalg.cross(lines[first[chosen]], lines[second[chosen]])
    F_mat = unit_matrix(cross_product_matrix(epipole) @ H)
    scorer = PairScorer(points1, points2, threshold, Fundamental())
    found = scorer.best(scorer.from_pixels(F_mat[F_mat.isfinite().flatten(1).all(1)]), 1).F_mat
    if len(found) == 0:
        return None
    loss = GemanMcClure(FINAL_LOSS_SCALE * threshold)
    return refine_fundamental(points1[None], points2[None], scorer.to_pixels(found), loss=loss).F_mat[0]
