r"""The fundamental matrix of the matches of two images, with its predicted error and the reasons to doubt it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.data.matching.matchers import one_to_one
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.geometry.manifold import nearest_essential
from kornia_learnnorm.geometry.pose import in_front, relative_pose
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.metrics.summary import median
from kornia_learnnorm.protocol import INLIER_THRESHOLD
from kornia_learnnorm.ransac.scoring import finite_and_bounded
from kornia_learnnorm.two_view.coherence import coherent_matches, fitting_share
from kornia_learnnorm.two_view.inputs import Points, check_settings, read_cameras, read_matches, read_size
from kornia_learnnorm.two_view.pair_estimate import NoReliableMatrixError, PairEstimate
from kornia_learnnorm.two_view.plane_distances import distances_from_plane
from kornia_learnnorm.two_view.reliability import (
    MAX_LOG_FALSE_ALARMS,
    MIN_MOTION,
    PairWarning,
    Stability,
    assess,
    choose_found,
    find_homography,
    log_false_alarms,
    log_false_samples,
    measure_stability,
    nominal_camera,
    random_parts,
)
from kornia_learnnorm.two_view.solver import TwoViewSolver

__all__ = ["estimate_matches", "settle_repeats"]

MIN_MATCHES = 9  # eight are explained by some matrix whatever they are
FEW_MATCHES = 400  # so few determine a matrix only with more inliers than RANSAC misses again and again
MAX_FAILED_PARTS = 6  # parts of few matches that are no better than chance, as all matches, before the search ends
MAX_EMPTY_PARTS = 2  # parts with no more inliers than a search among random matches finds, before the search ends
MIN_FALSE_SHARE = 0.15  # of the false matches off the plane; as many fit the true matrix by chance
MAX_FALSE_SHARE = 0.3  # of the false matches off the plane; more fit only a matrix that they decided
MAX_SHARE_LEFT = 0.8  # of the false matches per coherent one that fit the first matrix, for another to replace it
MIN_COHERENT_SHARE = 2 / 3  # of the coherent matches off the plane; with fewer, they belong to two matrices

Size = tuple[int, int]  # width and height, pixels


def estimate_matches(
    points1: Points,
    points2: Points,
    scores: Points | None = None,
    size1: tuple[int, int] | None = None,
    size2: tuple[int, int] | None = None,
    layer: LearnedEightPoint | None = None,
    threshold: float = INLIER_THRESHOLD,
    seed: int = 0,
    K1: Points | None = None,
    K2: Points | None = None,
) -> PairEstimate:
    """Return the fundamental matrix of matches with its predicted error and the reasons to doubt it.

    Where less than half of the matches are inliers, RANSAC searches again among those near its matrix. Where one
    homography explains most inliers, the matrix of this homography and the parallax of the other matches is tried too,
    and the better one is refined at the scale of the noise if all parallax is below the threshold.

    Args:
        points1: pixels in image 1 with shape (N, 2), an array or a tensor of numbers. Rows that are not finite, or more
            than 1e6 median distances from the other points, are left out.
        points2: pixels in image 2 with shape (N, 2).
        scores: from 0 to 1 with shape (N,), 1 minus Lowe's ratio or a matcher's confidence; all equal when not given.
        size1: width and height of image 1; as large as its points need when not given.
        size2: width and height of image 2.
        layer: estimates the matrix in the place of RANSAC.
        threshold: largest symmetric epipolar distance of an inlier, and RANSAC's threshold, pixels.
        seed: seed of RANSAC and of the parts of the matches.
        K1: camera of image 1, (3, 3), in pixels.
        K2: camera of image 2; both or none.

    Returns:
        the estimate; its matches are the given ones but for those left out, those that share a point with one of a
        higher score, and those that do not move at all, as on an overlay.

    Raises:
        NoReliableMatrixError: if there are fewer than nine matches or inliers, or no motion.
        TypeError: if points, scores or cameras are neither arrays nor tensors of numbers, or another argument is not
            of its type.
        ValueError: if shapes do not pair up, a value is out of range, only one camera is given, or one is not a finite
            and invertible (3, 3) matrix.

    """
    check_settings(threshold, seed, layer)
    cameras = read_cameras(K1, K2)
    points1, points2, scores = _usable_matches(*read_matches(points1, points2, scores), threshold)
    sizes = read_size("size1", size1, points1), read_size("size2", size2, points2)
    return _estimate(TwoViewSolver(points1, points2, scores, threshold, seed, layer, cameras), *sizes)


def _usable_matches(
    points1: Tensor, points2: Tensor, scores: Tensor, threshold: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the matches that move and share no point, best first; raise NoReliableMatrixError for too few."""
    given, finite = len(scores), finite_and_bounded(points1, points2, threshold)
    points1, points2, scores = points1[finite], points2[finite], scores[finite]
    kept = one_to_one(points1, points2, 1 - scores)
    motion = (points2 - points1).norm(dim=-1)[kept]
    if len(kept) >= MIN_MATCHES and median(motion).item() < MIN_MOTION:
        text = f"no motion between the images (median displacement {median(motion):.2g} px of {len(kept)} matches)"
        raise NoReliableMatrixError("no_motion", f"{text}: the fundamental matrix is not determined")
    kept = kept[motion >= MIN_MOTION]  # what stands still lies on an overlay or a dirty lens
    if len(kept) < MIN_MATCHES:
        text = f"{len(kept)} distinct matches of {given} are left, at least {MIN_MATCHES} are needed"
        raise NoReliableMatrixError("few_matches", text)
    return points1[kept], points2[kept], scores[kept]


def _estimate(solver: TwoViewSolver, size1: Size, size2: Size) -> PairEstimate:
    """Return the estimate of matches from the matrix of all and those of random parts."""
    found = _search(solver, size2)
    F_mat, inliers = found.F_mat, solver.inliers(found.F_mat)
    cameras = solver.cameras or (nominal_camera(size1), nominal_camera(size2))
    matches = solver.points1, solver.points2
    stability = measure_stability(found.F_parts, found.part_size, *matches, F_mat, inliers, *cameras)
    pose = _find_pose(solver, F_mat, inliers)
    return PairEstimate(
        F_mat=F_mat,
        **pose._asdict(),
        estimator=solver.estimator,
        points1=solver.points1,
        points2=solver.points2,
        scores=solver.scores,
        weights=inliers.double() if solver.layer is None else found.weights,
        inliers=inliers,
        predicted_error=min(stability.error, float(max(size2))),
        warnings=_find_warnings(solver, F_mat, size1, size2, stability, pose),
        size1=size1,
        size2=size2,
        ratio=None,
        threshold=solver.threshold,
        seed=solver.seed,
    )


class _Found(NamedTuple):
    """The matrix of all matches, and what tells how stable it is."""

    F_mat: Tensor
    weights: Tensor  # of the matches as the estimator sees them, (N,)
    F_parts: Tensor  # matrices of random parts, without those of failed searches, (P, 3, 3)
    part_size: int  # matches in a part


def _search(solver: TwoViewSolver, size2: Size) -> _Found:
    """Return the matrix of all matches; raise NoReliableMatrixError where too few agree with it."""
    F_mat, weights = solver.solve()
    parts = random_parts(len(weights), int(solver.inliers(F_mat).sum()), solver.seed)
    F_parts = _solve_parts(solver, F_mat, parts, size2)
    F_mat = solver.best_of(F_mat, F_parts)
    agree = int(solver.inliers(F_mat).sum())
    if agree < MIN_MATCHES:
        text = f"{agree} of {len(weights)} matches agree on a fundamental matrix within {solver.threshold:g} px"
        raise NoReliableMatrixError("no_consensus", f"{text}, at least {MIN_MATCHES} are needed")
    return _Found(F_mat, weights, choose_found(F_parts, solver.support(F_parts), agree), parts.shape[1])


def _solve_parts(solver: TwoViewSolver, F_mat: Tensor, parts: Tensor, size2: Size) -> Tensor:
    """Return the matrices of the parts; of few matches, only the first of them where these find no more than chance."""
    matches, found = len(solver.scores), F_mat[None]
    for rows in parts:
        found = torch.cat([found, solver.solve(rows)[0][None]])
        if matches > FEW_MATCHES:  # a late part can find what all others missed
            continue
        most, failed = int(solver.support(found).max()), len(found) - 1
        empty = log_false_samples(matches, most, solver.threshold, size2) > 0
        by_chance = log_false_alarms(matches, most, solver.threshold, size2) > MAX_LOG_FALSE_ALARMS
        if (failed == MAX_EMPTY_PARTS and empty) or (failed == MAX_FAILED_PARTS and by_chance):
            break
    return found[1:]


class _Pose(NamedTuple):
    """What cameras add to an estimate; all None without cameras, and R, t and front where two poses tie."""

    E_mat: Tensor | None = None
    R: Tensor | None = None
    t: Tensor | None = None
    front: Tensor | None = None


def _find_pose(solver: TwoViewSolver, F_mat: Tensor, inliers: Tensor) -> _Pose:
    if solver.cameras is None:
        return _Pose()
    K1, K2 = solver.cameras
    E_mat = nearest_essential(transform_fundamental(F_mat, K1, K2)[None])[0]
    pair = (K1[None], K2[None], solver.points1[None], solver.points2[None])
    R, t = relative_pose(F_mat[None], *pair, inliers[None])
    return _Pose(E_mat, R[0], t[0], in_front(R, t, *pair)[0]) if bool(R.isfinite().all()) else _Pose(E_mat)


def _find_warnings(
    solver: TwoViewSolver, F_mat: Tensor, size1: Size, size2: Size, stability: Stability, pose: _Pose
) -> tuple[PairWarning, ...]:
    points1, points2, threshold = solver.points1, solver.points2, solver.threshold
    distance = solver.distance(F_mat)
    near = distance < threshold
    H = None if solver.cameras else find_homography(points1[near], points2[near], threshold)
    off_plane = None if H is None else distances_from_plane(points1, points2, H, size1, size2, threshold)
    warnings = assess(points1, points2, distance, off_plane, threshold, size2, stability)
    if solver.cameras is None or pose.R is not None:
        return warnings
    return (
        *warnings,
        PairWarning("no_pose", "the matches do not decide between the four poses of the essential matrix"),
    )


def settle_repeats(
    first: PairEstimate, false1: Tensor, false2: Tensor, again: Callable[[Tensor], PairEstimate]
) -> PairEstimate:
    """Return the estimate of the coherent matches where false ones decided the first, with a warning where in doubt.

    It replaces the first one if fewer false matches fit its matrix for each coherent one that does. On rendered walls
    of repeated windows the predicted error of the answers without a warning is too small: 0.2 to 0.7 times the true one
    (10 % and 90 % quantiles).

    Args:
        first: estimate of all matches.
        false1: pixels in image 1 of matches that are not nearest neighbours in both directions, (M, 2), float64.
        false2: pixels in image 2, (M, 2).
        again: returns the estimate of some matches of the first one, from a mask of them, or raises
            NoReliableMatrixError.
    """
    coherent = _coherent_rows(first)
    plane = find_homography(first.points1[coherent], first.points2[coherent], first.threshold)
    if plane is None:
        return _doubted(first, "few matches move like their neighbours")

    def fitting(F_mat: Tensor) -> tuple[float, float]:
        """Return which shares of the false and of the coherent matches off the plane fit a matrix."""
        false = fitting_share(false1, false2, plane, F_mat, first.threshold)
        return false, fitting_share(first.points1[coherent], first.points2[coherent], plane, F_mat, first.threshold)

    best, (false, true) = first, fitting(first.F_mat)
    if false > MIN_FALSE_SHARE or true < MIN_COHERENT_SHARE:
        with suppress(NoReliableMatrixError):
            second = again(coherent)
            left, gained = fitting(second.F_mat)
            if left * true < MAX_SHARE_LEFT * false * gained:
                best, false, true = second, left, gained
    if false > MAX_FALSE_SHARE:
        return _doubted(
            best, f"{false:.0%} of the matches off the main plane that are nearest in one direction only fit"
        )
    if true < MIN_COHERENT_SHARE:
        return _doubted(best, f"only {true:.0%} of the matches off the main plane that move like their neighbours fit")
    return best


def _coherent_rows(estimate: PairEstimate) -> Tensor:
    """Return which matches of an estimate are coherent, (N,) bool; none where no homography explains its inliers."""
    points1, points2, inliers = estimate.points1, estimate.points2, estimate.inliers
    H = find_homography(points1[inliers], points2[inliers], estimate.threshold)
    return torch.zeros_like(inliers) if H is None else coherent_matches(points1, points2, H, estimate.threshold)


def _doubted(estimate: PairEstimate, reason: str) -> PairEstimate:
    warning = PairWarning("ambiguous", f"{reason}: texture that repeats")
    return replace(estimate, warnings=(*estimate.warnings, warning))
