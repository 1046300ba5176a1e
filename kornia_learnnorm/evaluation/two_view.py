r"""The fundamental matrix of the matches of two images, with its predicted error and the reasons to doubt it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.matching.matchers import one_to_one
from kornia_learnnorm.estimators.essential import refine_essential
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.evaluation.reliability import (
    MIN_MOTION,
    MIN_PLANAR_SHARE,
    PairWarning,
    assess,
    find_homography,
    measure_stability,
    nominal_camera,
    random_parts,
)
from kornia_learnnorm.geometry.checks import check_cameras, check_tensor
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.pose import in_front, relative_pose
from kornia_learnnorm.geometry.transforms import transform_fundamental, unit_fundamental
from kornia_learnnorm.metrics.summary import median
from kornia_learnnorm.protocol import INLIER_THRESHOLD
from kornia_learnnorm.ransac.local_optimization import FINAL_LOSS_SCALE
from kornia_learnnorm.ransac.parallax import fit_plane_and_parallax, parallax
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.ransac.scoring import PairScorer

__all__ = ["NoReliableMatrixError", "PairEstimate", "Points", "check_threshold", "estimate_matches", "float_tensor"]

MIN_MATCHES = 9  # eight are explained by some matrix whatever they are
MIN_SCORE_GAIN = 1.02  # of another hypothesis over the estimate of all matches, which otherwise stays

Points = Tensor | NDArray[np.floating[Any]]


class NoReliableMatrixError(ValueError):
    """The images or matches do not determine a fundamental matrix; ``code`` is one word for programs."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True, eq=False)
class PairEstimate:
    r"""The fundamental matrix of two images and the correspondences behind it; pixels are those of the full images."""

    F_mat: Tensor  # (3, 3), float64, unit Frobenius norm, x2^T F x1 = 0 in pixels
    E_mat: Tensor | None  # (3, 3), unit Frobenius norm, any sign; None without cameras
    R: Tensor | None  # rotation (3, 3) of X2 = R X1 + t; None without cameras, and where two poses tie
    t: Tensor | None  # direction of translation (3,); None without cameras
    estimator: str  # what made F_mat: "RANSAC" or "LearnedEightPoint"
    points1: Tensor  # pixels of the matches in image 1, (N, 2), float64
    points2: Tensor  # pixels of the matches in image 2, (N, 2), float64
    scores: Tensor  # 1 minus the ratio of each match, (N,), float64
    weights: Tensor  # probability of each match to be an inlier as the estimator sees it, (N,), float64
    inliers: Tensor  # mask of the matches with a distance to F_mat below the threshold, (N,), bool
    front: Tensor | None  # mask of the matches in front of both cameras, (N,), bool; None without cameras
    predicted_error: float  # median symmetric epipolar distance of exact correspondences that is expected, pixels
    warnings: tuple[PairWarning, ...]  # reasons to doubt F_mat; empty when all is well
    size1: tuple[int, int]  # width and height of image 1
    size2: tuple[int, int]  # width and height of image 2
    ratio: float  # largest ratio of the nearest to the second-nearest descriptor distance of the matches
    threshold: float  # largest symmetric epipolar distance of an inlier, pixels of the images as they were matched
    seed: int
    path1: Path | None = None
    path2: Path | None = None

    @property
    def num_matches(self) -> int:
        """Number of one-to-one matches."""
        return len(self.points1)

    @property
    def num_inliers(self) -> int:
        """Number of matches within the threshold."""
        return int(self.inliers.sum())

    @property
    def median_distance(self) -> float:
        """Median symmetric epipolar distance of the inliers, pixels."""
        inlying = self.points1[self.inliers], self.points2[self.inliers]
        return median(symmetric_epipolar_distance(*inlying, self.F_mat)).item()

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as what JSON can hold."""

        def rows(value: Tensor | None) -> Any:
            return None if value is None else value.tolist()

        def view(path: Path | None, size: tuple[int, int]) -> dict[str, Any]:
            return {"file": None if path is None else str(path), "width": size[0], "height": size[1]}

        return {
            "F": rows(self.F_mat),
            "E": rows(self.E_mat),
            "R": rows(self.R),
            "t": rows(self.t),
            "convention": "x2^T F x1 = 0, x = (column, row, 1) in pixels, X2 = R X1 + t; F and E have unit norm",
            "predicted_error_px": self.predicted_error,
            "warnings": [warning._asdict() for warning in self.warnings],
            "image1": view(self.path1, self.size1),
            "image2": view(self.path2, self.size2),
            "estimator": self.estimator,
            "seed": self.seed,
            "ratio": self.ratio,
            "threshold_px": self.threshold,
            "num_matches": self.num_matches,
            "num_inliers": self.num_inliers,
            "points1": rows(self.points1),
            "points2": rows(self.points2),
            "scores": rows(self.scores),
            "weights": rows(self.weights),
            "inliers": rows(self.inliers),
            "in_front": rows(self.front),
            "versions": {name: version(name) for name in ("kornia-learnnorm", "kornia", "torch")},
        }

    def summary(self) -> str:
        """Return F row by row, the pose with cameras, the counts, the predicted error and the warnings as text."""

        def rows(M: Tensor) -> list[str]:
            return ["  " + " ".join(f"{value: .9e}" for value in row) for row in M.tolist()]

        lines = ["F (x2^T F x1 = 0 in pixels, unit Frobenius norm)", *rows(self.F_mat)]
        if self.R is not None and self.t is not None:
            lines += ["R (X2 = R X1 + t)", *rows(self.R), "t (direction)", *rows(self.t[None])]
        share = self.num_inliers / self.num_matches
        return "\n".join(
            [
                *lines,
                f"by       {self.estimator}, seed {self.seed}",
                f"matches  {self.num_matches} (ratio test {self.ratio:g})",
                f"inliers  {self.num_inliers} ({share:.1%}, symmetric epipolar distance < {self.threshold:g} px)",
                f"error    {self.predicted_error:.2f} px predicted, inliers: median {self.median_distance:.2f} px",
                *(f"warning  {warning.code}: {warning.text}" for warning in self.warnings),
            ]
        )


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

    Where one homography explains most inliers, the matrix of this homography and the parallax of the other matches is
    tried too.

    Args:
        points1: pixels in image 1 with shape (N, 2).
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
        the estimate; its matches are the given ones but for those that share a point with one of a higher score, and
        those that do not move at all, as on an overlay.

    Raises:
        NoReliableMatrixError: if there are fewer than nine matches or inliers, or no motion.
        TypeError: if an argument is neither a floating-point array nor a tensor.
        ValueError: if shapes do not pair up, a value is not finite or out of range, or only one camera is given.

    """
    check_threshold(threshold)
    points1, points2, scores = _check_matches(points1, points2, scores)
    camera1 = None if K1 is None else float_tensor("K1", K1)
    camera2 = None if K2 is None else float_tensor("K2", K2)
    check_cameras(camera1, camera2)
    cameras = None if camera1 is None or camera2 is None else (camera1, camera2)
    points1, points2, scores = _usable_matches(points1, points2, scores)
    size1, size2 = size1 or _extent(points1), size2 or _extent(points2)
    solve = _solver(points1, points2, scores, layer, threshold, seed, cameras)
    F_mat, weights = solve(torch.arange(len(scores)))
    agree = symmetric_epipolar_distance(points1, points2, F_mat) < threshold
    parts = random_parts(len(scores), int(agree.sum()), seed)
    F_parts = torch.stack([solve(rows)[0] for rows in parts])
    F_mat = _best_of(points1, points2, F_mat, F_parts, threshold, cameras)
    inliers = symmetric_epipolar_distance(points1, points2, F_mat) < threshold
    if int(inliers.sum()) < MIN_MATCHES:
        found = f"{int(inliers.sum())} of {len(scores)} matches agree on a fundamental matrix within {threshold:g} px"
        raise NoReliableMatrixError("no_consensus", f"{found}, at least {MIN_MATCHES} are needed")
    K_near1, K_near2 = cameras or (nominal_camera(size1), nominal_camera(size2))
    stability = measure_stability(F_parts, parts.shape[1], points1, points2, F_mat, inliers, K_near1, K_near2)
    H = None if cameras else find_homography(points1[inliers], points2[inliers], threshold)
    warnings = assess(points1, points2, inliers, H, threshold, size2, stability)
    pose = None if cameras is None else _pose(points1, points2, F_mat, inliers, cameras)
    if cameras is not None and pose is None:
        warnings += (
            PairWarning("no_pose", "the matches do not decide between the four poses of the essential matrix"),
        )
    R, t, front = pose or (None, None, None)
    return PairEstimate(
        F_mat=F_mat,
        E_mat=None if cameras is None else unit_fundamental(transform_fundamental(F_mat, *cameras)),
        R=R,
        t=t,
        estimator=type(layer).__name__ if layer is not None else RANSAC.__name__,
        points1=points1,
        points2=points2,
        scores=scores,
        weights=weights if layer is not None else inliers.double(),
        inliers=inliers,
        front=front,
        predicted_error=min(stability.error, float(max(size2))),
        warnings=warnings,
        size1=size1,
        size2=size2,
        ratio=1.0,
        threshold=threshold,
        seed=seed,
    )


def _check_matches(points1: Points, points2: Points, scores: Points | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return matches in float64, with scores of one where there are none; raise a clear error for anything else."""
    x1, x2 = float_tensor("points1", points1), float_tensor("points2", points2)
    score = torch.ones(len(x1), dtype=torch.float64) if scores is None else float_tensor("scores", scores)
    if x1.shape != x2.shape or x1.shape[1:] != (2,) or score.shape != x1.shape[:1]:
        shapes = " and ".join(str([*value.shape]) for value in (x1, x2, score))
        raise ValueError(f"points of shape (N, 2) and scores of shape (N,) expected, got {shapes}")
    if not all(bool(value.isfinite().all()) for value in (x1, x2, score)):
        raise ValueError("points and scores must be finite, got NaN or infinity")
    if len(score) and not (float(score.min()) >= 0 and float(score.max()) <= 1):
        raise ValueError(f"scores must be from 0 to 1, got {float(score.min()):g} to {float(score.max()):g}")
    return x1, x2, score


def _usable_matches(points1: Tensor, points2: Tensor, scores: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the matches that move and share no point, best first; raise NoReliableMatrixError for too few."""
    kept = one_to_one(points1, points2, 1 - scores)
    motion = (points2 - points1).norm(dim=-1)[kept]
    if len(kept) >= MIN_MATCHES and median(motion).item() < MIN_MOTION:
        text = f"no motion between the images (median displacement {median(motion):.2g} px of {len(kept)} matches)"
        raise NoReliableMatrixError("no_motion", f"{text}: the fundamental matrix is not determined")
    kept = kept[motion >= MIN_MOTION]  # what stands still lies on an overlay or a dirty lens
    if len(kept) < MIN_MATCHES:
        text = f"{len(kept)} distinct matches of {len(scores)} are left, at least {MIN_MATCHES} are needed"
        raise NoReliableMatrixError("few_matches", text)
    return points1[kept], points2[kept], scores[kept]


def _pose(
    points1: Tensor, points2: Tensor, F_mat: Tensor, inliers: Tensor, cameras: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return rotation, translation and which matches are in front of both cameras; None where two poses tie."""
    pair = (cameras[0][None], cameras[1][None], points1[None], points2[None])
    R, t = relative_pose(F_mat[None], *pair, inliers[None])
    return (R[0], t[0], in_front(R, t, *pair)[0]) if bool(R.isfinite().all()) else None


def _solver(
    points1: Tensor,
    points2: Tensor,
    scores: Tensor,
    layer: LearnedEightPoint | None,
    threshold: float,
    seed: int,
    cameras: tuple[Tensor, Tensor] | None,
) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """Return a function from rows of the matches to their matrix (3, 3) and weights (M,)."""
    ransac = RANSAC(inl_th=threshold, seed=seed)

    def solve(rows: Tensor) -> tuple[Tensor, Tensor]:
        x1, x2, score = points1[rows], points2[rows], scores[rows]
        if layer is None:
            found = ransac.estimate(x1, x2, score.clamp(min=1e-3), *(cameras or ()))
            F_mat, weights = found.F_mat, found.inliers.double()
        else:
            with torch.no_grad():
                estimate = layer.estimate(x1[None], x2[None], scores=score[None])
            F_mat, weights = estimate.F_mat[0], estimate.weights[0]
        if not cameras:
            return _try_plane_and_parallax(x1, x2, F_mat, threshold, seed), weights
        if layer is not None:
            F_mat = _refine(x1, x2, F_mat, threshold, cameras)
        return F_mat, weights

    return solve


def _best_of(
    points1: Tensor,
    points2: Tensor,
    F_mat: Tensor,
    F_parts: Tensor,
    threshold: float,
    cameras: tuple[Tensor, Tensor] | None,
) -> Tensor:
    """Return the matrix of all matches, or that of a part, refined on all, where it scores higher on all."""
    scorer = PairScorer(points1, points2, threshold)

    def score(F_mat: Tensor) -> float:
        return float(scorer.best(scorer.from_pixels(F_mat), 1).score.sum())

    best = scorer.best(scorer.from_pixels(F_parts), 1)
    if float(best.score.sum()) <= MIN_SCORE_GAIN * score(F_mat[None]):
        return F_mat
    other = _refine(points1, points2, scorer.to_pixels(best.F_mat)[0], threshold, cameras)
    return other if score(other[None]) > MIN_SCORE_GAIN * score(F_mat[None]) else F_mat


def _refine(
    points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float, cameras: tuple[Tensor, Tensor] | None
) -> Tensor:
    """Return the matrix refined on the robust loss with which RANSAC ends, of known cameras if there are."""
    loss = GemanMcClure(FINAL_LOSS_SCALE * threshold)
    x1, x2 = points1[None], points2[None]
    if cameras is None:
        return refine_fundamental(x1, x2, F_mat[None], loss=loss).F_mat[0]
    K1, K2 = cameras[0][None], cameras[1][None]
    E_mat = unit_fundamental(transform_fundamental(F_mat[None], K1, K2))
    return refine_essential(x1, x2, E_mat, K1, K2, loss=loss).F_mat[0]


def _try_plane_and_parallax(points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float, seed: int) -> Tensor:
    """Return the matrix of a plane and parallax where one homography explains most inliers and it scores higher."""
    inliers = symmetric_epipolar_distance(points1, points2, F_mat) < threshold
    H = find_homography(points1[inliers], points2[inliers], threshold) if int(inliers.sum()) >= 8 else None
    if H is None:
        return F_mat
    distance = parallax(points1, points2, H)
    if float((distance[inliers] < 3 * threshold).double().mean()) <= MIN_PLANAR_SHARE:
        return F_mat
    other = fit_plane_and_parallax(points1, points2, H, threshold, seed)
    if other is None:
        return F_mat
    scorer = PairScorer(points1, points2, threshold)
    score, other_score = (scorer.best(scorer.from_pixels(F[None]), 1).score.sum() for F in (F_mat, other))
    return other if other_score > MIN_SCORE_GAIN * score else F_mat


def float_tensor(name: str, value: Points) -> Tensor:
    """Return an array or tensor in float64; raise a TypeError for anything else."""
    value = torch.from_numpy(value) if isinstance(value, np.ndarray) else value
    check_tensor(name, value)
    return value.detach().double()


def _extent(points: Tensor) -> tuple[int, int]:
    """Return the width and height of an image that holds all points."""
    width, height = (points.amax(0).clamp(min=1.0).ceil() + 1).tolist()
    return int(width), int(height)


def check_threshold(threshold: float) -> None:
    """Raise ValueError unless a threshold is positive and finite."""
    if not 0 < threshold < float("inf"):
        raise ValueError(f"threshold must be positive and finite, got {threshold:g} px")
