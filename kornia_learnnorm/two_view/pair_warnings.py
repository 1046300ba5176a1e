"""The reasons to doubt the matrix of an image pair, or its cameras."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.minimal_solver import spread_across
from kornia_learnnorm.two_view.camera_misfit import camera_misfit, lens_misfit
from kornia_learnnorm.two_view.input_checks import Cameras

MAX_ANGLE = 8.0  # degrees; a pose that moves by more in half of the parts is unstable
MIN_INLIERS = 16  # with fewer, no estimate of the error is reliable either
MIN_SPREAD = 0.02  # of the image diagonal; standard deviation of the inliers across their longest direction
SEARCH_SAMPLES = 50_000  # minimal samples of a search that finds nothing
MAX_LOG_FALSE_ALARMS = -2.0  # log10 of the expected number of random models with as much support
MIN_MISFIT = 5e-5  # of the largest coordinate, about the longer side; photographs called undistorted have up to 3e-5
MAX_LOG_CHANCE_MISFIT = -3.0  # log10 of the probability that noise alone adds as much
MIN_POSE_CHANGE = 3.0  # degrees; a slight lens distortion contradicts the camera too, but hardly changes the pose
CONTRADICTION = "the matches contradict K1 and K2"
MIN_FOCAL = 0.05  # of the median coordinate of points, about half of the image; no lens is as wide
MAX_FOCAL, MAX_ASPECT = 100.0, 2.0  # of the largest coordinate of points, and of the other focal length
MAX_OFFSET = 0.2  # of both sides of an image; a principal point is closer to the centre


class PairWarning(NamedTuple):
    """A reason to doubt a matrix."""

    code: str  # few_inliers, chance, clustered, planar, relief, small_motion, unstable, ambiguous, no_pose or cameras
    text: str  # one sentence for the user


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
    spread = min(spread_across(points[inliers]) for points in (points1, points2)) / math.hypot(*size2)
    if spread < MIN_SPREAD:
        found["clustered"] = f"the inliers lie close to one line or one point: {spread:.1%} of the image diagonal apart"
    if angle > MAX_ANGLE:
        found["unstable"] = f"the pose changes by {angle:.0f} degrees when the matches are drawn anew"
    return tuple(PairWarning(*item) for item in found.items())


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
    counts. A true matrix can have too few inliers to stand out among all of those, and still more than a search
    among random matches finds.
    """
    others = max(0, inliers - Fundamental.sample_size)
    samples = 3 * SEARCH_SAMPLES * math.comb(max(0, matches - Fundamental.sample_size), others)
    return math.log10(max(1, samples)) + others * _log_strip(threshold, size)


def _log_strip(threshold: float, size: Size) -> float:
    """Return log10 of a bound on the share of an image within a threshold (pixels) of a line."""
    return math.log10(min(1.0, 2 * threshold * math.hypot(*size) / math.prod(size)))


def find_camera_doubt(
    cameras: Cameras,
    sizes: tuple[Size | None, Size | None],
    points1: Tensor,
    points2: Tensor,
    F_mat: Tensor | None,
    threshold: float,
) -> tuple[PairWarning, ...]:
    """Return at most one warning: of a camera that is not of its image's size, or that matches (N, 2) contradict.

    Sizes are None where they are not known, F_mat (3, 3) where the matches may be those of a plane.
    """
    for name, K, size, points in zip(("K1", "K2"), cameras, sizes, (points1, points2), strict=True):
        fx, fy = (K.diagonal()[:2] / K[2, 2]).tolist()
        text = f"{name} has the focal lengths {fx:.3g} and {fy:.3g} px, "
        if min(fx, fy) < MIN_FOCAL * float(points.median()):
            return (PairWarning("cameras", f"{text}too short for these points: they must be pixels"),)
        if max(fx, fy) > min(MAX_ASPECT * min(fx, fy), MAX_FOCAL * float(points.max())):
            return (PairWarning("cameras", f"{text}which is implausible for these points"),)
        # Where the size is not known, the principal point is off the centre of the points, too.
        centre, high = K[:2, 2] / K[2, 2], points.amax(0) if size is None else points.new_tensor(size)
        low = points.amin(0) if size is None else torch.zeros_like(high)
        (x, y), offset, among = centre / high, (centre / high - 0.5).abs(), ((centre - low) / (high - low) - 0.5).abs()
        outside = size is not None and bool((offset > 0.5).any())
        if outside or bool((offset.minimum(among) > MAX_OFFSET).all()):
            image = "its image, as far as its points show" if size is None else "its image"
            text = f"the principal point of {name} is at {x:.0%} of the width and {y:.0%} of the height of {image}"
            return (PairWarning("cameras", f"{text}: {name} may be that of another image size"),)
    if F_mat is None:
        return ()
    about, least = (points1, points2, F_mat, threshold, cameras), MIN_MISFIT * float(points2.max())
    lens, k1 = lens_misfit(*about)
    found = [(camera_misfit(*about), "without them"), (lens, f"with a lens distortion of about k1 = {k1:.2g}")]
    found = [
        (misfit, text)
        for misfit, text in found
        if misfit.distance >= least and misfit.log_chance <= MAX_LOG_CHANCE_MISFIT and misfit.angle >= MIN_POSE_CHANGE
    ]
    if not found:
        return ()
    misfit, text = max(found)
    return (PairWarning("cameras", f"{CONTRADICTION}: {text} the pose differs by {misfit.angle:.0f} degrees"),)


def drop_contradiction(warnings: tuple[PairWarning, ...]) -> tuple[PairWarning, ...]:
    """Return the warnings without that of matches that contradict their cameras."""
    return tuple(warning for warning in warnings if not warning.text.startswith(CONTRADICTION))
