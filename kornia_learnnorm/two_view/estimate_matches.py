"""The fundamental matrix of the matches of two images, with its predicted error and the reasons to doubt it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.data.matching.matchers import one_to_one
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.geometry.pose import in_front, relative_pose
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.metrics.median import median
from kornia_learnnorm.models.essential import nearest_essential
from kornia_learnnorm.protocol import INLIER_THRESHOLD
from kornia_learnnorm.ransac.samplers import ProsacSampler, Sampler
from kornia_learnnorm.ransac.scoring import finite_and_bounded
from kornia_learnnorm.two_view.inputs import Points, check_settings, read_cameras, read_matches, read_size
from kornia_learnnorm.two_view.parallax import distances_from_plane, find_main_plane
from kornia_learnnorm.two_view.predicted_error import nominal_camera, predict_error
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate
from kornia_learnnorm.two_view.solver import MIN_MATCHES, TwoViewSolver
from kornia_learnnorm.two_view.warnings import PairWarning, find_warnings

__all__ = ["estimate_matches"]

MIN_MOTION = 0.1  # pixels, median over the matches; below, the camera has not moved


def estimate_matches(
    points1: Points,
    points2: Points,
    scores: Points | None = None,
    size1: Size | None = None,
    size2: Size | None = None,
    layer: LearnedEightPoint | None = None,
    threshold: float = INLIER_THRESHOLD,
    seed: int = 0,
    K1: Points | None = None,
    K2: Points | None = None,
    sampler: Callable[..., Sampler] = ProsacSampler,
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
        sampler: how the scores steer RANSAC, see :class:`~kornia_learnnorm.RANSAC`. A matcher's confidences, such as
            LightGlue's, want :class:`~kornia_learnnorm.ransac.samplers.WeightedSampler`: samples of the highest alone
            are worse.

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
    size1, size2 = read_size("size1", size1, points1), read_size("size2", size2, points2)
    solver = TwoViewSolver(points1, points2, scores, threshold, seed, layer, cameras, sampler)
    found = solver.search(size2)
    F_mat, inliers = found.F_mat, solver.inliers(found.F_mat)
    cameras = cameras or (nominal_camera(size1), nominal_camera(size2))
    error = predict_error(found.F_parts, found.part_size, points1, points2, F_mat, inliers, *cameras)
    pose = _find_pose(solver, F_mat, inliers)
    return PairEstimate(
        F_mat=F_mat,
        **pose._asdict(),
        estimator=solver.estimator,
        points1=points1,
        points2=points2,
        scores=scores,
        weights=inliers.double() if layer is None else found.weights,
        inliers=inliers,
        predicted_error=min(error.distance, float(max(size2))),
        warnings=_all_warnings(solver, F_mat, size1, size2, error.angle, pose),
        size1=size1,
        size2=size2,
        ratio=None,
        threshold=threshold,
        seed=seed,
    )


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


class _Pose(NamedTuple):  # all None without cameras, and R, t and front where two poses tie
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


def _all_warnings(
    solver: TwoViewSolver, F_mat: Tensor, size1: Size, size2: Size, angle: float, pose: _Pose
) -> tuple[PairWarning, ...]:
    points1, points2, threshold = solver.points1, solver.points2, solver.threshold
    distance = solver.distance(F_mat)
    near = distance < threshold
    H = None if solver.cameras else find_main_plane(points1[near], points2[near], threshold)
    off_plane = None if H is None else distances_from_plane(points1, points2, H, size1, size2, threshold)
    warnings = find_warnings(points1, points2, distance, off_plane, threshold, size2, angle)
    if solver.cameras is None or pose.R is not None:
        return warnings
    text = "the matches do not decide between the four poses of the essential matrix"
    return (*warnings, PairWarning("no_pose", text))
