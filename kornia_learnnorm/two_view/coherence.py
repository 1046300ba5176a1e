r"""Matches that move like the matches around them, unlike the false ones of repeated texture.

Equal windows of a wall match each other along its rows, so that the false matches agree on an epipole where these rows
meet, and on a matrix that more matches fit than the true one. Which matches fit cannot tell these matrices apart; that
the false matches jump away from their neighbours does.
"""

from __future__ import annotations

import torch
from kornia.geometry.linalg import transform_points
from torch import Tensor

from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.two_view.parallax import parallax

__all__ = ["coherent_matches", "fitting_share"]

NUM_NEIGHBOURS = 48  # matches nearest to a match in an image
ROUNDS = 2  # in the second, neighbours count by their own share in the first
MIN_COHERENT = 0.8  # of the weights of the neighbours, in both images, have the parallax of a coherent match
MAX_PARALLAX_CHANGE = 0.3  # of the distance between neighbours; 3 thresholds where this is less
PARALLAX = 3.0  # thresholds; a match that the homography misses by more lies off the plane
MIN_MATCHES = 16  # off the plane; fewer tell nothing of a matrix


def coherent_matches(points1: Tensor, points2: Tensor, H: Tensor, threshold: float) -> Tensor:
    """Return which matches have the parallax of most matches around them, in both images.

    A false match of repeated texture jumps to a copy, away from its neighbours in one image or in both. Where most
    matches around a true one are false, these count little: in a second round the neighbours of a match are weighted by
    the share of their own neighbours that agree with them.

    Args:
        points1: pixels in image 1 with shape (N, 2), float64.
        points2: pixels in image 2 with shape (N, 2).
        H: homography that explains most matches, (3, 3); parallax is measured from where it moves points1.
        threshold: largest distance of an inlier, pixels.

    Returns:
        a mask (N,).

    References:
        J. Bian et al., GMS: grid-based motion statistics for fast, ultra-robust feature correspondence, CVPR 2017;
        J. Ma et al., Locality preserving matching, IJCV 2019.

    """
    vectors = points2 - transform_points(H[None], points1[None])[0]
    views = [_neighbours(points, vectors, PARALLAX * threshold) for points in (points1, points2)]
    share = torch.ones_like(points1[:, 0])
    for _ in range(ROUNDS):
        share = torch.minimum(*(_agreeing_share(share[indices], agrees) for indices, agrees in views))
    return share >= MIN_COHERENT


def _neighbours(points: Tensor, vectors: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return the rows (N, K) of the neighbours of each point (N, 2), and which have a vector (N, 2) like its own."""
    number = min(NUM_NEIGHBOURS, len(points) - 1)
    apart = torch.cdist(points, points)
    apart.fill_diagonal_(torch.inf)
    nearest = apart.topk(number, largest=False)
    change = (vectors[nearest.indices] - vectors[:, None]).norm(dim=-1)
    return nearest.indices, change < (MAX_PARALLAX_CHANGE * nearest.values).clamp(min=least)


def _agreeing_share(weights: Tensor, agrees: Tensor) -> Tensor:
    """Return which share of the neighbours' weights (N, K) those that agree have, (N,); 0 where all weights are."""
    share: Tensor = (weights * agrees).sum(-1) / weights.sum(-1).clamp(min=torch.finfo(weights.dtype).tiny)
    return share


def fitting_share(points1: Tensor, points2: Tensor, H: Tensor, F_mat: Tensor, threshold: float) -> float:
    """Return which share of the matches off a plane fits a matrix; 1 where fewer than 16 lie off it.

    Args:
        points1: pixels in image 1, (N, 2), float64.
        points2: pixels in image 2, (N, 2).
        H: homography of the plane, (3, 3).
        F_mat: matrix, (3, 3).
        threshold: largest distance of an inlier, pixels.
    """
    off = parallax(points1, points2, H) > PARALLAX * threshold
    fits = symmetric_epipolar_distance(points1[off], points2[off], F_mat) < threshold
    return float(fits.double().mean()) if len(fits) >= MIN_MATCHES else 1.0
