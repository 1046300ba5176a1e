"""The reasons to doubt the matrix of an image pair."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.models.fundamental import Fundamental

MAX_ANGLE = 8.0  # degrees; a pose that moves by more in half of the parts is unstable
MIN_INLIERS = 16  # with fewer, no estimate of the error is reliable either
MIN_SPREAD = 0.02  # of the image diagonal; standard deviation of the inliers across their longest direction
SEARCH_SAMPLES = 50_000  # minimal samples of a search that finds nothing
MAX_LOG_FALSE_ALARMS = -2.0  # log10 of the expected number of random models with as much support


class PairWarning(NamedTuple):
    """A reason to doubt a matrix."""

    code: str  # few_inliers, chance, clustered, planar, unstable, ambiguous, no_pose or cameras
    text: str  # one sentence for people


def find_warnings(
    points1: Tensor, points2: Tensor, inliers: Tensor, threshold: float, size2: Size, angle: float
) -> tuple[PairWarning, ...]:
    """Return the reasons to doubt the matrix of matches (N, 2) with a mask of inliers (N,); none when all is well.

    ``angle`` is that of the :class:`~kornia_learnnorm.two_view.predicted_error.PredictedError`.
    """
    found, total, matches = {}, int(inliers.sum()), len(inliers)
    if total < MIN_INLIERS:
        found["few_inliers"] = f"only {total} of {matches} matches agree on the matrix"
    if log_false_alarms(matches, total, threshold, size2) > MAX_LOG_FALSE_ALARMS:
        found["chance"] = f"{total} of {matches} matches agree within {threshold:g} px, no more than chance would give"
    spread = min(_spread(points[inliers]) for points in (points1, points2)) / math.hypot(*size2)
    if spread < MIN_SPREAD:
        found["clustered"] = f"the inliers lie close to one line or one point: {spread:.1%} of the image diagonal apart"
    if angle > MAX_ANGLE:
        found["unstable"] = f"the pose changes by {angle:.0f} degrees when the matches are drawn anew"
    return tuple(PairWarning(*item) for item in found.items())


def _spread(points: Tensor) -> float:
    """Return the standard deviation of points (N, 2) across the direction in which they spread most, pixels."""
    return float(torch.linalg.svdvals(points - points.mean(0))[-1]) / math.sqrt(len(points))


def log_false_alarms(matches: int, inliers: int, threshold: float, size: Size, model: str = "fundamental") -> float:
    """Return log10 of the expected number of matrices with as many inliers among as many random matches.

    Fundamental matrices from seven matches, and the probability that a random point of image 2 lies within the
    threshold, pixels, of a line (L. Moisan, B. Stival, A probabilistic criterion to detect rigid point matches between
    two images and estimate the fundamental matrix, IJCV 2004); homographies from four, and of a point (L. Moisan, P.
    Moulon, P. Monasse, Automatic homographic registration of a pair of images, with a contrario elimination of
    outliers, IPOL 2012).
    """
    if model == "fundamental":
        sample, log_share = 7, _log_strip(threshold, size)
    else:
        sample, log_share = 4, math.log10(min(1.0, math.pi * threshold**2 / math.prod(size)))
    tests = max(1, matches - sample) * math.comb(matches, inliers) * math.comb(inliers, sample)
    return math.log10(max(1, tests)) + (inliers - sample) * log_share


def log_false_samples(matches: int, inliers: int, threshold: float, size: Size) -> float:
    """Return log10 of the expected number of a search's samples with as many inliers among random matches.

    A search tries the three matrices of 50,000 samples of seven, far fewer than all that :func:`log_false_alarms`
    counts. A true matrix with too few inliers to be told from all those can have more than a search among random
    matches finds.
    """
    others = max(0, inliers - Fundamental.sample_size)
    samples = 3 * SEARCH_SAMPLES * math.comb(max(0, matches - Fundamental.sample_size), others)
    return math.log10(max(1, samples)) + others * _log_strip(threshold, size)


def _log_strip(threshold: float, size: Size) -> float:
    """Return log10 of a bound on the share of an image within a threshold (pixels) of a line."""
    return math.log10(min(1.0, 2 * threshold * math.hypot(*size) / math.prod(size)))
