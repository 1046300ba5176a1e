"""The fundamental matrix or homography of matches, with its predicted error and warnings."""

import math
from typing import Any, cast

import torch
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.data.matching.matchers import one_to_one
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.geometry.checks import without_autocast
from kornia_learnnorm.geometry.pose import in_front, relative_pose
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.metrics.statistics import median
from kornia_learnnorm.models.essential import nearest_essential
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import INLIER_THRESHOLD
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.ransac.scoring import finite_and_bounded
from kornia_learnnorm.two_view import predicted_error
from kornia_learnnorm.two_view.input_checks import (
    Cameras,
    Points,
    check_settings,
    read_cameras,
    read_matches,
    read_size,
)
from kornia_learnnorm.two_view.model_choice import choose_model
from kornia_learnnorm.two_view.pair_warnings import (
    CONTRADICTION,
    MAX_LOG_FALSE_ALARMS,
    PairWarning,
    find_camera_doubt,
    find_warnings,
    log_false_alarms,
)
from kornia_learnnorm.two_view.parallax import MAX_LOG_CHANCE_PARALLAX, OFF_PLANE
from kornia_learnnorm.two_view.plane_pose import PlanePose, angle_between, plane_poses
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate
from kornia_learnnorm.two_view.solver import MIN_MATCHES, Solution, TwoViewSolver

MIN_MOTION = 0.1  # pixels, median over the matches; below, the camera has not moved
MIN_EXTENT = 2.0  # pixels; points that stay below it must be normalised coordinates
MIN_RIVAL_SHARE = 0.6  # outliers that must agree on a second matrix for a warning, over the number of inliers
MIN_RIVAL_ANGLE = 15.0  # degrees between the poses of both matrices for a warning
MIN_DEVIATIONS = 3.0  # standard deviations by which matches off a plane must prefer a pose, or there is a warning
MIN_FREE_GAIN = 1.25  # inliers without cameras over inliers with them for a warning of wrong cameras
MIN_FREE_SHARE = 0.25  # of the matches; inliers without cameras for this warning, as false matches agree on some matrix
# Fields of PairEstimate (with those of a pose where there is one), standard errors, and warnings.
Answer = tuple[dict[str, Any], predicted_error.PredictedError, tuple[PairWarning, ...]]


def estimate_matches(
    points1: Points,
    points2: Points,
    scores: Points | None = None,
    size1: Size | Points | None = None,
    size2: Size | Points | None = None,
    layer: LearnedEightPoint | None = None,
    threshold: float = INLIER_THRESHOLD,
    seed: int = 0,
    K1: Points | None = None,
    K2: Points | None = None,
    model: str = "auto",
) -> PairEstimate:
    """Return the fundamental matrix or homography of matches, with cameras the pose, a predicted error and warnings.

    The result is a homography if the matches do not determine a fundamental matrix, as on a plane or when the camera
    only rotates, see :func:`~kornia_learnnorm.two_view.model_choice.choose_model`. If one homography explains most
    inliers, the fundamental matrix from this homography and the parallax of the other matches is tried as well.

    Args:
        points1: pixels in image 1 with shape (N, 2), an array or a tensor of numbers. Rows that are not finite, or more
            than 1e6 median distances from the other points, are left out.
        points2: pixels in image 2 with shape (N, 2).
        scores: from 0 to 1 with shape (N,), 1 minus Lowe's ratio or a matcher's confidence; default: all equal.
        size1: width and height of image 1, pixels, or LightGlue's ``image_size[0]``; default: the smallest that holds
            the points.
        size2: width and height of image 2.
        layer: estimates the fundamental matrix instead of RANSAC.
        threshold: RANSAC's threshold and the largest distance of an inlier, pixels: the symmetric epipolar distance, or
            for a homography the distance in image 2.
        seed: seed of RANSAC and of the random subsets of the matches.
        K1: camera of image 1, (3, 3), in pixels.
        K2: camera of image 2; both or none.
        model: ``"auto"``, ``"fundamental"`` or ``"homography"``.

    Returns:
        the estimate. Its matches are the given ones at the indices ``rows``: left out are, besides the rows above,
        matches that share a point with one of a higher score, and those that do not move at all, as on an overlay.

    Raises:
        NoReliableMatrixError: if there are fewer than nine matches or inliers, or no motion.
        ImportError: if OpenCV, of the extra ``images``, is not installed.
        TypeError: if an argument is not of its type.
        ValueError: if shapes do not pair up, a value is out of range, over a fifth of the points lies outside of its
            image, or a camera is missing or not invertible.
    """
    import_extra("cv2", "images", "estimate_matches")
    check_settings(threshold, seed, layer, model)
    cameras = read_cameras(K1, K2)
    points1, points2, scores = read_matches(points1, points2, scores)
    rows = _usable_rows(points1, points2, scores, threshold)
    points1, points2, scores = points1[rows], points2[rows], scores[rows]
    unknown = size1 is None, size2 is None
    size1, size2 = read_size("size1", size1, points1), read_size("size2", size2, points2)
    given = None if unknown[0] else size1, None if unknown[1] else size2
    with without_autocast(points1):
        solver = TwoViewSolver(points1, points2, scores, threshold, seed, layer, cameras)
        free = 0
        if cameras is not None:
            solver = solver.limit_samples(free := solver.free_support())
        choice, found, H_mat = choose_model(solver, model, size1, size2)
        F_mat = None if found is None else found.matrix
        if choice.model == "homography":
            fields, error, doubts = _answer_homography(solver, cast(Tensor, H_mat), F_mat)
        else:
            fields, error, doubts = _answer_fundamental(solver, cast(Solution, found), size1, size2)
        relief = choice.model == "fundamental" and choice.parallax is not None and not choice.parallax.planar
        if cameras is not None and choice.model == "fundamental" and not relief and H_mat is not None:
            doubts += _find_plane_pose(solver, H_mat, fields)
        if cameras is not None:  # a plane contradicts no cameras, but wrong cameras can make a scene look like a plane
            doubt = find_camera_doubt(cameras, given, points1, points2, F_mat if relief else None, threshold)
            doubts += doubt or _compare_free(solver, fields, free)
    if cameras is None and choice.model == "fundamental" and choice.parallax is not None and not relief:
        doubts += (PairWarning("planar", choice.parallax.describe(threshold)),)
    if model == "homography" and choice.parallax is not None and choice.parallax.log_chance <= MAX_LOG_CHANCE_PARALLAX:
        doubts += (PairWarning("relief", f"{choice.parallax.describe(threshold)}: H holds for one plane of the scene"),)
    about = points1, points2, fields["inliers"], threshold, size2, error.angle
    return PairEstimate(
        choice=choice,
        H_mat=H_mat,
        **fields,
        estimator=(RANSAC if layer is None or choice.model == "homography" else type(layer)).__name__,
        points1=points1,
        points2=points2,
        scores=scores,
        predicted_error=min(math.hypot(error.distance, predicted_error.CAMERA_ERROR * max(size2)), float(max(size2))),
        warnings=(*find_warnings(*about), *doubts),
        size1=size1,
        size2=size2,
        ratio=None,
        threshold=threshold,
        seed=seed,
        rows=rows,
    )


def _usable_rows(points1: Tensor, points2: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Return the rows of the matches that move and share no point; raise NoReliableMatrixError for too few."""
    given, finite = len(scores), finite_and_bounded(points1, points2, threshold).nonzero()[:, 0]
    points1, points2, scores = points1[finite], points2[finite], scores[finite]
    kept = one_to_one(points1, points2, 1 - scores)
    motion = (points2 - points1).norm(dim=-1)[kept]
    if len(kept) >= MIN_MATCHES and (most := float(points2.abs().max())) < MIN_EXTENT:
        raise ValueError(f"pixels expected, got points up to {most:.2g}; multiply normalised ones by a focal length")
    if len(kept) >= MIN_MATCHES and median(motion).item() < MIN_MOTION:
        text = f"no motion between the images (median displacement {median(motion):.2g} px of {len(kept)} matches)"
        raise NoReliableMatrixError("no_motion", f"{text}: the fundamental matrix is not determined")
    kept = kept[motion >= MIN_MOTION]  # matches that do not move lie on an overlay or a dirty lens
    if len(kept) < MIN_MATCHES:
        text = f"{len(kept)} distinct matches of {given} are left, at least {MIN_MATCHES} are needed"
        raise NoReliableMatrixError("few_matches", text)
    return finite[kept]


def _answer_fundamental(solver: TwoViewSolver, found: Solution, size1: Size, size2: Size) -> Answer:
    F_mat, matches = found.matrix, (solver.points1, solver.points2)
    inliers = solver.distance(F_mat) < solver.threshold
    cameras = solver.cameras or (predicted_error.nominal_camera(size1), predicted_error.nominal_camera(size2))
    error = predicted_error.predict_error(found.parts, found.part_size, *matches, F_mat, inliers, *cameras)
    weights = inliers.double() if solver.layer is None else found.weights
    fields: dict[str, Any] = {"F_mat": F_mat, "inliers": inliers, "weights": weights}
    doubts = _find_rival(solver, F_mat, inliers, size2, *cameras)
    if (motion := median((matches[1] - matches[0]).norm(dim=-1)).item()) < solver.threshold:
        text = f"half of the matches move by less than {motion:.2g} px, which any motion fits within the threshold"
        doubts += (PairWarning("small_motion", text),)
    if solver.cameras is None:
        return fields, error, doubts
    fields["E_mat"] = nearest_essential(transform_fundamental(F_mat, *cameras)[None])[0]
    K1, K2, x1, x2 = (value[None] for value in (*cameras, *matches))
    R, t = relative_pose(F_mat[None], K1, K2, x1, x2, inliers[None])
    if not bool(R.isfinite().all()):
        text = "the matches do not decide between the four poses of the essential matrix"
        return fields, error, (*doubts, PairWarning("no_pose", text))
    return fields | {"R": R[0], "t": t[0], "front": in_front(R[None], t[None], K1, K2, x1, x2)[0, 0]}, error, doubts


def _compare_free(solver: TwoViewSolver, fields: dict[str, Any], free: int) -> tuple[PairWarning, ...]:
    """Return a warning where many more matches, ``free``, agree on a matrix without cameras than on F or H."""
    if fields["F_mat"] is None:
        return ()
    agree = max(int(solver.support(fields["F_mat"])), int(fields["inliers"].sum()))
    if free < max(MIN_FREE_GAIN * agree, MIN_FREE_SHARE * len(solver.scores)):
        return ()
    return (PairWarning("cameras", f"{CONTRADICTION}: without them {free} matches agree, with them {agree}"),)


def _find_rival(
    solver: TwoViewSolver, F_mat: Tensor, inliers: Tensor, size2: Size, K1: Tensor, K2: Tensor
) -> tuple[PairWarning, ...]:
    """Return a warning where nearly as many outliers agree on a matrix of another pose, and more than by chance."""
    rival, agree = solver.rival(inliers), int(inliers.sum())
    if rival is None or rival[1] < MIN_RIVAL_SHARE * agree:
        return ()
    other, support = rival
    if log_false_alarms(len(inliers) - agree, support, solver.threshold, size2) > MAX_LOG_FALSE_ALARMS:
        return ()
    matches = solver.points1[inliers], solver.points2[inliers]
    angle = float(predicted_error.pose_angles(F_mat, other[None], *matches, K1, K2))
    if angle < MIN_RIVAL_ANGLE:
        return ()
    text = f"{agree} matches agree on this matrix, {support} others on one whose pose differs by {angle:.0f} degrees"
    return (PairWarning("ambiguous", text),)


def _find_plane_pose(solver: TwoViewSolver, H_mat: Tensor, fields: dict[str, Any]) -> tuple[PairWarning, ...]:
    """Return a warning where a plane has another pose that matches agree with about as well as with that of E."""
    cameras, inliers = cast(Cameras, solver.cameras), fields["inliers"]
    near = solver.distance(H_mat, "homography") < OFF_PLANE * solver.threshold
    if "R" not in fields or not bool(near.any()):
        return ()
    own = PlanePose(fields["R"], fields["t"])
    for pose in plane_poses(H_mat, *cameras, solver.points1[near], solver.points2[near]):
        angle = angle_between(own, [pose])
        if pose.t is None or angle < MIN_RIVAL_ANGLE:
            continue
        others = solver.distance(solver.refine(pose.fundamental(*cameras))) < solver.threshold
        first, second = int((inliers & ~others).sum()), int((others & ~inliers).sum())
        if first - second <= MIN_DEVIATIONS * math.sqrt(first + second):
            text = f"the plane has a second pose, {angle:.0f} degrees away: too few matches off it decide"
            return (PairWarning("ambiguous", text),)
    return ()


def _answer_homography(solver: TwoViewSolver, H_mat: Tensor, F_mat: Tensor | None) -> Answer:
    found, cameras, matches = solver.check_homography(H_mat), solver.cameras, (solver.points1, solver.points2)
    inliers = found.weights > 0
    about = found.parts, found.part_size, solver.points1, H_mat, inliers
    fields: dict[str, Any] = {"F_mat": F_mat, "inliers": inliers, "weights": found.weights}
    if cameras is None:
        return fields, predicted_error.predict_transfer_error(*about), ()
    seen = (*cameras, *(points[inliers] for points in matches))
    poses = plane_poses(H_mat, *seen)
    if not poses:
        text = "no plane in front of both cameras has this homography"
        return fields, predicted_error.predict_transfer_error(*about), (PairWarning("no_pose", text),)
    doubts: tuple[PairWarning, ...] = ()
    if len(poses) > 1:  # matches off the plane agree with the true pose alone
        near = solver.distance(torch.stack([pose.fundamental(*cameras) for pose in poses])) < solver.threshold
        order = near.sum(-1).argsort(descending=True, stable=True).tolist()
        poses = [poses[row] for row in order]
        off_plane = solver.distance(H_mat, "homography") > OFF_PLANE * solver.threshold
        first, second = (int((near[row] & off_plane).sum()) for row in order[:2])
        angle = angle_between(poses[0], poses[1:])
        if first - second <= MIN_DEVIATIONS * math.sqrt(first + second) and angle > MIN_RIVAL_ANGLE:
            text = f"the plane has a second pose, {angle:.0f} degrees away (other_pose): too few matches off it decide"
            doubts = (PairWarning("ambiguous", text),)
    (R, t, n), *others = poses
    angles = torch.tensor([angle_between(poses[0], plane_poses(part, *seen)) for part in found.parts]).double()
    fields["R"] = R
    if t is not None:
        front = in_front(R[None, None], t[None, None], *(value[None] for value in (*cameras, *matches)))[0, 0]
        fields |= {"F_mat": poses[0].fundamental(*cameras), "E_mat": poses[0].essential(), "t": t, "n": n}
        fields |= {"front": front, "other_pose": others[0] if others else None}
    return fields, predicted_error.predict_transfer_error(*about, angles), doubts
