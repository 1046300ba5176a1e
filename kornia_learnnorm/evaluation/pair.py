"""The fundamental matrix of two image files: one-to-one matches, RANSAC or the learned layer, and what they support."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.data.images import import_cv2, read_image
from kornia_learnnorm.data.matching.matchers import match_images
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.files import write_text
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.summary import median
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO
from kornia_learnnorm.ransac.ransac import RANSAC

__all__ = ["PairEstimate", "estimate_pair", "write_json"]

MIN_DISPLACEMENT = 0.1  # pixels, median over the matches; with a smaller one the camera has not moved
MAX_LOG_FALSE_ALARMS = -2.0  # log10 of the expected number of models with as many inliers among random matches
MIN_PARALLAX = 0.05  # share of the inliers that the best homography must leave unexplained


@dataclass(frozen=True, eq=False)
class PairEstimate:
    """The fundamental matrix of two images and the correspondences behind it."""

    F_mat: Tensor  # (3, 3), float64, unit Frobenius norm, x2^T F x1 = 0 in pixels
    estimator: str  # what made F_mat: "RANSAC" or "LearnedEightPoint"
    points1: Tensor  # pixels of the matches in image 1, (N, 2), float64
    points2: Tensor  # pixels of the matches in image 2, (N, 2), float64
    inliers: Tensor  # mask of the matches with a distance to F_mat below the threshold, (N,), bool
    mean_distance: float  # mean symmetric epipolar distance of the inliers, pixels
    median_distance: float  # median symmetric epipolar distance of the inliers, pixels
    path1: Path
    path2: Path
    size1: tuple[int, int]  # width and height of image 1
    size2: tuple[int, int]  # width and height of image 2
    ratio: float  # largest ratio of the nearest to the second-nearest descriptor distance of the matches
    threshold: float  # largest symmetric epipolar distance of an inlier, pixels

    @property
    def num_matches(self) -> int:
        """Number of one-to-one matches that passed the ratio test."""
        return len(self.points1)

    @property
    def num_inliers(self) -> int:
        """Number of matches within the threshold."""
        return int(self.inliers.sum())

    def summary(self) -> str:
        """Return F row by row, the counts and the errors as text."""
        rows = [" ".join(f"{value: .9e}" for value in row) for row in self.F_mat.tolist()]
        share = self.num_inliers / self.num_matches
        return "\n".join(
            [
                "F (x2^T F x1 = 0 in pixels, unit Frobenius norm)",
                *(f"  {row}" for row in rows),
                f"by       {self.estimator}",
                f"matches  {self.num_matches} (ratio test {self.ratio:g})",
                f"inliers  {self.num_inliers} ({share:.1%}, symmetric epipolar distance < {self.threshold:g} px)",
                f"distance of the inliers: mean {self.mean_distance:.3f} px, median {self.median_distance:.3f} px",
            ]
        )


def estimate_pair(
    path1: str | Path,
    path2: str | Path,
    layer: LearnedEightPoint | None = None,
    ratio: float = RATIO,
    threshold: float = INLIER_THRESHOLD,
    seed: int = 0,
) -> PairEstimate:
    """Return the fundamental matrix of two image files with its matches and inliers.

    SIFT matches that pass the ratio test are made one-to-one: of those that share a point, the one of smallest ratio
    counts. :class:`~kornia_learnnorm.RANSAC`, or a learned layer, reads them with their scores, 1 minus the ratio.

    Args:
        path1: file of image 1.
        path2: file of image 2.
        layer: estimates the matrix in the place of RANSAC.
        ratio: largest ratio of the nearest to the second-nearest descriptor distance.
        threshold: largest symmetric epipolar distance of an inlier, and RANSAC's threshold, pixels.
        seed: seed of RANSAC; equal files and seeds give equal estimates.

    Returns:
        the estimate; all its numbers are finite.

    Raises:
        FileNotFoundError: if a file does not exist.
        ValueError: if a file is not an image, ``ratio`` or ``threshold`` is out of range, or the images do not
            determine a fundamental matrix: a blank image, fewer than eight matches or inliers, no motion, all inliers
            on one homography, or no more inliers than random matches would have.
        ImportError: if OpenCV is not installed.

    """
    if not 0 < ratio <= 1:
        raise ValueError(f"ratio must be above 0 and at most 1, got {ratio:g}")
    if not 0 < threshold < float("inf"):
        raise ValueError(f"threshold must be positive and finite, got {threshold:g} px")
    image1, image2 = read_image(path1), read_image(path2)
    try:
        points1, points2, scores = _one_to_one_matches(*match_images(image1, image2), ratio)
        if layer is None:
            F_mat = RANSAC(inl_th=threshold, seed=seed)(points1, points2, scores)[0]
        else:
            with torch.no_grad():
                F_mat = layer(points1[None], points2[None], scores=scores[None])[0]
        inliers = symmetric_epipolar_distance(points1, points2, F_mat) < threshold
        _check_inliers(inliers, threshold)
        _check_parallax(points1[inliers], points2[inliers], threshold)
        _check_chance(len(inliers), int(inliers.sum()), threshold, image2.shape)
    except ValueError as error:
        raise ValueError(f"{path1} and {path2}: {error}") from error
    distances = symmetric_epipolar_distance(points1[inliers], points2[inliers], F_mat)
    return PairEstimate(
        F_mat=F_mat,
        estimator=type(layer).__name__ if layer is not None else RANSAC.__name__,
        points1=points1,
        points2=points2,
        inliers=inliers,
        mean_distance=distances.mean().item(),
        median_distance=median(distances).item(),
        path1=Path(path1),
        path2=Path(path2),
        size1=(image1.shape[1], image1.shape[0]),
        size2=(image2.shape[1], image2.shape[0]),
        ratio=ratio,
        threshold=threshold,
    )


def _one_to_one_matches(
    points1: Tensor, points2: Tensor, ratios: Tensor, ratio: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the matches below the ratio that share no point, and their scores, float64.

    Raise ValueError for too few matches or no motion.
    """
    rows = torch.cat([points1, points2, ratios[:, None]], -1).double().numpy()
    rows = rows[np.lexsort(rows.T)]  # by ratio
    rows = rows[rows[:, 4] < ratio]
    for columns in (slice(0, 2), slice(2, 4)):
        rows = rows[np.sort(np.unique(rows[:, columns], axis=0, return_index=True)[1])]
    kept = torch.from_numpy(rows)
    if len(kept) < 8:
        raise ValueError(
            f"{len(kept)} distinct matches of {len(ratios)} pass the ratio test {ratio:g}, at least 8 are needed"
        )
    displacement = median((kept[:, 2:4] - kept[:, :2]).norm(dim=-1)).item()
    if displacement < MIN_DISPLACEMENT:
        raise ValueError(
            f"no motion between the images (median displacement {displacement:.2g} px of {len(kept)} matches): the "
            "fundamental matrix is not determined"
        )
    return kept[:, :2], kept[:, 2:4], 1 - kept[:, 4]


def _check_inliers(inliers: Tensor, threshold: float) -> None:
    if inliers.sum() < 8:
        raise ValueError(
            f"{int(inliers.sum())} of {len(inliers)} matches agree on a fundamental matrix within {threshold:g} px, at "
            "least 8 are needed"
        )


def _check_parallax(points1: Tensor, points2: Tensor, threshold: float) -> None:
    """Raise ValueError if one homography explains the inliers: a plane, or a camera that only rotates."""
    cv2 = import_cv2()
    try:
        _, mask = cv2.findHomography(points1.numpy(), points2.numpy(), cv2.USAC_MAGSAC, threshold)
    except cv2.error:  # OpenCV 4 raises when too few points are left to sample from
        mask = None
    explained = 0 if mask is None else int(mask.sum())
    if len(points1) - explained < max(2, MIN_PARALLAX * len(points1)):
        raise ValueError(
            f"degenerate: one homography explains {explained} of {len(points1)} inliers within {threshold:g} px (a "
            "plane, or a camera that only rotates): the fundamental matrix is not determined"
        )


def _check_chance(matches: int, inliers: int, threshold: float, shape: tuple[int, ...]) -> None:
    """Raise ValueError if random matches are likely to have as many inliers.

    The expected number of false alarms is that of Moisan and Stival (A probabilistic criterion to detect rigid point
    matches between two images and estimate the fundamental matrix, IJCV 2004): models from seven matches, and the
    probability that a random point lies within the threshold of a line.
    """
    strip = min(1.0, 2 * threshold * math.hypot(*shape) / math.prod(shape))
    tests = (matches - 7) * math.comb(matches, inliers) * math.comb(inliers, 7)
    log_false_alarms = math.log10(max(1, tests)) + (inliers - 7) * math.log10(strip)
    if log_false_alarms > MAX_LOG_FALSE_ALARMS:
        raise ValueError(
            f"{inliers} of {matches} matches agree on a fundamental matrix within {threshold:g} px, no more than "
            "chance would give: the fundamental matrix is not determined"
        )


def write_json(path: str | Path, estimate: PairEstimate) -> None:
    """Write an estimate as a JSON file, whole or not at all."""
    content = {
        "F": estimate.F_mat.tolist(),
        "convention": "x2^T F x1 = 0, x = (column, row, 1) in pixels, unit Frobenius norm",
        "image1": {"file": str(estimate.path1), "width": estimate.size1[0], "height": estimate.size1[1]},
        "image2": {"file": str(estimate.path2), "width": estimate.size2[0], "height": estimate.size2[1]},
        "estimator": estimate.estimator,
        "matches": estimate.num_matches,
        "inliers": estimate.num_inliers,
        "inlier_symmetric_epipolar_distance_px": {"mean": estimate.mean_distance, "median": estimate.median_distance},
        "ratio": estimate.ratio,
        "threshold_px": estimate.threshold,
    }
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")
