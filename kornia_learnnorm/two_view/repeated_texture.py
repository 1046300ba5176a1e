r"""Detect false matches of repeated texture, which agree with each other, and estimate without them.

Equal windows of a wall match each other along its rows, so that the false matches agree on an epipole where these rows
meet, and on a matrix that more matches fit than the true one. The number of inliers cannot tell these matrices
apart, but false matches move differently from their neighbours and are nearest neighbours in one direction only. Points
are pixels (N, 2) in float64, matrices (3, 3), and thresholds pixels.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import torch
from kornia.geometry.linalg import transform_points
from torch import Tensor

from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.two_view.pair_warnings import MIN_INLIERS, PairWarning, drop_contradiction
from kornia_learnnorm.two_view.parallax import MAX_LOG_CHANCE_PARALLAX, find_main_plane, parallax, parallax_evidence
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate

NUM_NEIGHBOURS = 48  # matches nearest to a match in an image
ROUNDS = 2  # in the second, neighbours are weighted by their own share in the first
MIN_COHERENT = 0.8  # of the weights of the neighbours, in both images, agree with a coherent match's parallax
MAX_PARALLAX_CHANGE = 0.3  # of the distance between neighbours; 3 thresholds where this is less
PARALLAX = 3.0  # thresholds; a match that the homography misses by more lies off the plane
MIN_MATCHES_OFF_PLANE = 16  # with fewer, shares of them are not reliable
MIN_FALSE_SHARE = 0.15  # of the false matches off the plane; as many fit the true matrix by chance
MAX_FALSE_SHARE = 0.3  # of the false matches off the plane; more fit only a matrix that they decided
MAX_SHARE_LEFT = 0.8  # of the first matrix's false matches per coherent one, which a second one must stay below
MIN_COHERENT_SHARE = 2 / 3  # of the coherent matches off the plane; with fewer, another matrix is sought
MIN_AGREEING_SHARE = 0.8  # of the inliers of either matrix off the plane that fit the other one, for them to be alike


def mutual_share(points1: Tensor, points2: Tensor, mutual: Tensor, F_mat: Tensor, threshold: float) -> float:
    """Return the share of mutual matches among those off the main plane that fit F; 1 if they are fewer than 16.

    Nearly all true matches are, so a low share means false matches that agree with each other.
    """
    fits = symmetric_epipolar_distance(points1, points2, F_mat) < threshold
    H = find_main_plane(points1[fits], points2[fits], threshold) if int(fits.sum()) >= 8 else None
    if H is not None:
        fits &= parallax(points1, points2, H) > PARALLAX * threshold
    return float(mutual[fits].double().mean()) if int(fits.sum()) >= MIN_INLIERS else 1.0


def resolve_ambiguity(
    first: PairEstimate, false1: Tensor, false2: Tensor, again: Callable[[Tensor], PairEstimate]
) -> PairEstimate:
    """Return the estimate of the coherent matches where false ones decided the first, with a warning where in doubt.

    It replaces the first one if fewer false (not mutual) matches fit its matrix for each coherent match that does. If
    both matrices agree, there is no warning. ``again`` maps a mask of the first one's matches to their estimate.
    """
    inlying = first.points1[first.inliers], first.points2[first.inliers]
    H, coherent = find_main_plane(*inlying, first.threshold), torch.zeros_like(first.inliers)
    if H is not None:
        coherent = coherent_matches(first.points1, first.points2, H, first.threshold)
    matches = first.points1[coherent], first.points2[coherent]
    plane = find_main_plane(*matches, first.threshold)
    if plane is None:
        return _with_doubt(first, "few matches move like their neighbours")
    kept = drop_contradiction(first.warnings)
    if kept != first.warnings:  # false matches may contradict cameras that the coherent ones do not
        with suppress(NoReliableMatrixError):
            doubts = again(coherent).warnings
            if drop_contradiction(doubts) == doubts:
                first = replace(first, warnings=kept)

    def fitting(F_mat: Tensor) -> list[float]:  # shares of the false and of the coherent matches off the plane
        return [fitting_share(*x, plane, F_mat, first.threshold) for x in ((false1, false2), matches)]

    def doubtful(estimate: PairEstimate, true: float) -> bool:  # whether the coherent matches do not support it
        if true < MIN_COHERENT_SHARE and (estimate is first or estimate.E_mat is not None):
            return True
        evidence = parallax_evidence(*matches, estimate.matrix, parallax(*matches, plane), first.threshold)
        return estimate.E_mat is None and evidence > MAX_LOG_CHANCE_PARALLAX  # with cameras a plane is enough

    best, (false, true) = first, fitting(first.matrix)
    if false > MIN_FALSE_SHARE or doubtful(first, true):
        with suppress(NoReliableMatrixError):
            second = again(coherent)
            left, gained = fitting(second.matrix)
            if left * true < MAX_SHARE_LEFT * false * gained:
                best, false, true = second, left, gained
            if _agree(first, second, plane):
                return best
    if false > MAX_FALSE_SHARE:
        reason = f"{false:.0%} of the matches off the main plane that are nearest in one direction only fit"
        return _with_doubt(best, reason)
    if doubtful(best, true):
        return _with_doubt(best, "the matches that move like their neighbours fit another matrix or several")
    return best


def _agree(first: PairEstimate, second: PairEstimate, H: Tensor) -> bool:
    """Return whether most inliers of either matrix off the plane of a homography fit the other; false without any."""
    for own, other in ((first, second), (second, first)):
        points1, points2 = own.points1[own.inliers], own.points2[own.inliers]
        off = parallax(points1, points2, H) > PARALLAX * own.threshold
        distance = symmetric_epipolar_distance(points1[off], points2[off], other.matrix)
        if not float((distance < PARALLAX * own.threshold).double().mean()) >= MIN_AGREEING_SHARE:
            return False
    return True


def _with_doubt(estimate: PairEstimate, reason: str) -> PairEstimate:
    others = (warning for warning in estimate.warnings if warning.code != "ambiguous")
    warning = PairWarning("ambiguous", f"{reason}: texture that repeats")
    return replace(estimate, warnings=(*others, warning))


def coherent_matches(points1: Tensor, points2: Tensor, H: Tensor, threshold: float) -> Tensor:
    """Return which matches have the parallax, from where H moves points1, of most matches around them in both images.

    In a second round neighbours are weighted by the share of their own neighbours that agree with them: where most
    matches around a true one are false, these count little (J. Bian et al., GMS: grid-based motion statistics for fast,
    ultra-robust feature correspondence, CVPR 2017; J. Ma et al., Locality preserving matching, IJCV 2019).
    """
    vectors = points2 - transform_points(H[None], points1[None])[0]
    views = [_neighbours(points, vectors, PARALLAX * threshold) for points in (points1, points2)]
    share, tiny = torch.ones_like(points1[:, 0]), torch.finfo(points1.dtype).tiny
    for _ in range(ROUNDS):
        weights = [(share[indices], agrees) for indices, agrees in views]
        share = torch.minimum(*((w * agrees).sum(-1) / w.sum(-1).clamp(min=tiny) for w, agrees in weights))
    return share >= MIN_COHERENT


def _neighbours(points: Tensor, vectors: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return the rows (N, K) of the neighbours of each point (N, 2), and which have a vector (N, 2) like its own."""
    number = min(NUM_NEIGHBOURS, len(points) - 1)
    apart = torch.cdist(points, points)
    apart.fill_diagonal_(torch.inf)
    nearest = apart.topk(number, largest=False)
    change = (vectors[nearest.indices] - vectors[:, None]).norm(dim=-1)
    return nearest.indices, change < (MAX_PARALLAX_CHANGE * nearest.values).clamp(min=least)


def fitting_share(points1: Tensor, points2: Tensor, H: Tensor, F_mat: Tensor, threshold: float) -> float:
    """Return the share of the matches off the plane of a homography that fits a matrix; 1 if fewer than 16 are off."""
    off = parallax(points1, points2, H) > PARALLAX * threshold
    fits = symmetric_epipolar_distance(points1[off], points2[off], F_mat) < threshold
    return float(fits.double().mean()) if len(fits) >= MIN_MATCHES_OFF_PLANE else 1.0
