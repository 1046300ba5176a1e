"""The fundamental matrix of two image files: matches, robust inliers, and the eight-point algorithm on the inliers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.data.images import import_cv2, read_image
from kornia_learnnorm.data.matching.matchers import match_images
from kornia_learnnorm.estimators.fundamental import find_fundamental
from kornia_learnnorm.files import write_text
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.summary import median
from kornia_learnnorm.normalizers.contract import Normalizer
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO

__all__ = ["PairEstimate", "estimate_pair", "write_json"]

MIN_DISPLACEMENT = 0.1  # pixels, median over the matches; with a smaller one the camera has not moved
MAX_LOG_FALSE_ALARMS = -2.0  # log10 of the expected number of models with as many inliers among random matches
MIN_PARALLAX = 0.05  # share of the inliers that the best homography must leave unexplained
MAX_FITS = 3  # least-squares fits to the inliers
MAGSAC_CONFIDENCE = 0.9999
MAGSAC_MAX_SAMPLES = 10_000


@dataclass(frozen=True, eq=False)
class PairEstimate:
    """The fundamental matrix of two images and the correspondences behind it."""

    F_mat: Tensor  # (3, 3), float64, unit Frobenius norm, x2^T F x1 = 0 in pixels
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
        """Number of distinct matches that passed the ratio test."""
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
                f"matches  {self.num_matches} (ratio test {self.ratio:g})",
                f"inliers  {self.num_inliers} ({share:.1%}, symmetric epipolar distance < {self.threshold:g} px)",
                f"distance of the inliers: mean {self.mean_distance:.3f} px, median {self.median_distance:.3f} px",
            ]
        )


def estimate_pair(
    path1: str | Path,
    path2: str | Path,
    normalizer: Normalizer,
    ratio: float = RATIO,
    threshold: float = INLIER_THRESHOLD,
    seed: int = 0,
) -> PairEstimate:
    """Return the fundamental matrix of two image files with its matches and inliers.

    SIFT matches pass the ratio test, OpenCV's MAGSAC finds the first inliers, and the normalised eight-point algorithm
    with ``normalizer`` fits all inliers. The inliers of the fit are fitted again, at most twice, as long as their
    number grows.

    Args:
        path1: file of image 1.
        path2: file of image 2.
        normalizer: maps ``(points1, points2, weights)`` to the transforms :math:`(B, 3, 3)` of both views.
        ratio: largest ratio of the nearest to the second-nearest descriptor distance.
        threshold: largest symmetric epipolar distance of an inlier, pixels.
        seed: seed of the order in which MAGSAC gets the matches; equal files and seeds give equal estimates.

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
        points1, points2 = _distinct_matches(*match_images(image1, image2), ratio)
        inliers = _robust_inliers(points1, points2, threshold, seed)
        F_mat, inliers = _fit(points1, points2, inliers, normalizer, threshold)
        _check_parallax(points1[inliers], points2[inliers], threshold)
        _check_chance(len(inliers), int(inliers.sum()), threshold, image2.shape)
    except ValueError as error:
        raise ValueError(f"{path1} and {path2}: {error}") from error
    distances = symmetric_epipolar_distance(points1[inliers], points2[inliers], F_mat)
    return PairEstimate(
        F_mat=F_mat,
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


def _distinct_matches(points1: Tensor, points2: Tensor, ratios: Tensor, ratio: float) -> tuple[Tensor, Tensor]:
    """Return the distinct matches below the ratio, float64; raise ValueError for too few matches or no motion."""
    kept = torch.from_numpy(np.unique(torch.cat([points1, points2], -1)[ratios < ratio].double().numpy(), axis=0))
    if len(kept) < 8:
        raise ValueError(
            f"{len(kept)} distinct matches of {len(ratios)} pass the ratio test {ratio:g}, at least 8 are needed"
        )
    displacement = median((kept[:, 2:] - kept[:, :2]).norm(dim=-1)).item()
    if displacement < MIN_DISPLACEMENT:
        raise ValueError(
            f"no motion between the images (median displacement {displacement:.2g} px of {len(kept)} matches): the "
            "fundamental matrix is not determined"
        )
    return kept[:, :2], kept[:, 2:]


def _robust_inliers(points1: Tensor, points2: Tensor, threshold: float, seed: int) -> Tensor:
    """Return MAGSAC's inliers, a mask (N,)."""
    cv2 = import_cv2()
    # OpenCV draws the samples of MAGSAC from a generator with a fixed seed: what varies is the order of the matches.
    order = torch.randperm(len(points1), generator=torch.Generator().manual_seed(seed))
    inliers = torch.zeros(len(points1), dtype=torch.bool)
    options = threshold, MAGSAC_CONFIDENCE, MAGSAC_MAX_SAMPLES
    inliers[order] = _magsac(cv2.findFundamentalMat, points1[order], points2[order], *options)
    _check_inliers(inliers, threshold)
    return inliers


def _magsac(find: Callable[..., Any], points1: Tensor, points2: Tensor, threshold: float, *options: float) -> Tensor:
    """Return the inliers (N,) that an OpenCV function finds with MAGSAC; none if it finds no model."""
    cv2 = import_cv2()
    try:
        _, mask = find(points1.numpy(), points2.numpy(), cv2.USAC_MAGSAC, threshold, *options)
    except cv2.error:  # OpenCV 4 raises when too few points are left to sample from
        mask = None
    return torch.zeros(len(points1), dtype=torch.bool) if mask is None else torch.from_numpy(mask.ravel()).bool()


def _check_inliers(inliers: Tensor, threshold: float) -> None:
    if inliers.sum() < 8:
        raise ValueError(
            f"{int(inliers.sum())} of {len(inliers)} matches agree on a fundamental matrix within {threshold:g} px, at "
            "least 8 are needed"
        )


def _fit(
    points1: Tensor, points2: Tensor, inliers: Tensor, normalizer: Normalizer, threshold: float
) -> tuple[Tensor, Tensor]:
    """Return F fitted to all inliers and its inliers; refit while the number of inliers grows."""
    F_mat, best = torch.zeros(3, 3, dtype=torch.float64), torch.zeros_like(inliers)
    for _ in range(MAX_FITS):
        with torch.no_grad():
            F_fit = find_fundamental(points1[inliers][None], points2[inliers][None], normalizer=normalizer)[0]
        inliers = symmetric_epipolar_distance(points1, points2, F_fit) < threshold
        if inliers.sum() <= best.sum():
            break
        F_mat, best = F_fit, inliers
        if inliers.sum() < 8:
            break
    _check_inliers(best, threshold)
    return F_mat, best


def _check_parallax(points1: Tensor, points2: Tensor, threshold: float) -> None:
    """Raise ValueError if one homography explains the inliers: a plane, or a camera that only rotates."""
    explained = int(_magsac(import_cv2().findHomography, points1, points2, threshold).sum())
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
        "matches": estimate.num_matches,
        "inliers": estimate.num_inliers,
        "inlier_symmetric_epipolar_distance_px": {"mean": estimate.mean_distance, "median": estimate.median_distance},
        "ratio": estimate.ratio,
        "threshold_px": estimate.threshold,
    }
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")
