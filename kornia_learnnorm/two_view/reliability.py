"""How far a matrix may be off, from those of random parts of the matches, and the reasons to doubt it."""

import math
from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.linalg import transform_points
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE
from kornia_learnnorm.two_view.parallax import parallax

__all__ = ["PairWarning", "PredictedError", "find_warnings", "log_false_alarms", "log_false_samples"]
__all__ += ["predict_error", "predict_transfer_error"]

NUM_PARTS = 12  # random parts of the matches that are solved again
PART_INLIERS = 48  # expected in a part, where these are more than half and less than four fifths of all inliers
MIN_SUPPORT = 0.75  # of the inliers; the matrix of a part with fewer is that of a search that failed
MIN_SOLVED_PARTS = 4  # with fewer matrices of as much support, those of all parts count
NOMINAL_FOCAL = 1.2  # of the longer image side: focal length where no camera is given
COMMON_ERRORS = 400  # matches beyond which more do not help: the errors of neighbours are alike
MEDIAN_SQUARE = 0.455  # of a standard normal variable
MIN_NOISE = 1e-6  # thresholds; of matches without noise
CAMERA_ERROR = 1e-4  # of the longer image side, in photographs: what matches do not tell, such as distortion
MAX_ANGLE = 8.0  # degrees; a pose that moves by more in half of the parts is unstable
MIN_INLIERS = 16  # with fewer, no estimate of the error is reliable either
MIN_SPREAD = 0.02  # of the image diagonal; standard deviation of the inliers across their longest direction
SEARCH_SAMPLES = 50_000  # minimal samples of a search that finds nothing
MAX_LOG_FALSE_ALARMS = -2.0  # log10 of the expected number of random models with as much support


class PredictedError(NamedTuple):
    """Standard errors of a fundamental matrix or a homography."""

    distance: float  # median symmetric epipolar distance, or distance in image 2 of points moved by H, pixels
    angle: float  # larger angle of the rotations and of the directions of translation, degrees


def random_parts(number: int, inliers: int, seed: int) -> Tensor:
    """Return the rows (P, M) of random parts of the matches: half of them, or so many that 48 inliers are expected."""
    share = min(max(0.5, PART_INLIERS / max(1, inliers)), 0.8)
    size = min(max(8, round(share * number)), number - 1)
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randperm(number, generator=generator)[:size] for _ in range(NUM_PARTS)])


def drop_failed_parts(F_parts: Tensor, support: Tensor, inliers: int) -> Tensor:
    """Return the matrices of parts (P, 3, 3) whose support (P,) is most inliers; all of them where these are few."""
    solved = support >= MIN_SUPPORT * inliers
    return F_parts[solved] if int(solved.sum()) >= MIN_SOLVED_PARTS else F_parts


def predict_error(
    F_parts: Tensor, size: int, points1: Tensor, points2: Tensor, F_mat: Tensor, inliers: Tensor, K1: Tensor, K2: Tensor
) -> PredictedError:
    """Return the standard errors of ``F_mat`` from its distance to the matrices of random parts of the matches.

    A part of m of N matches, drawn without replacement, differs from all of them with N / m - 1 times the variance of
    the latter (delete-d jackknife: J. Shao, C. Wu, A general theory for jackknife variance estimation, Annals of
    Statistics 1989). Errors of neighbouring matches are alike, so no more than 400 of them count.

    ``F_parts`` (P, 3, 3) are zeros where there is no matrix; a part has ``size`` of the matches (N, 2), of which
    ``inliers`` (N,) are those of ``F_mat`` (3, 3). The cameras (3, 3) may be guesses.
    """
    x1, x2 = points1[inliers], points2[inliers]
    lines = convert_points_to_homogeneous(x1) @ F_mat.mT
    normal = lines[:, :2]
    x2 = x2 - (((normal * x2).sum(-1) + lines[:, 2]) / normal.square().sum(-1))[:, None] * normal  # onto their lines
    x1, x2 = (x.expand(len(F_parts), -1, -1) for x in (x1, x2))
    distance = symmetric_epipolar_distance(x1, x2, F_parts).nan_to_num(nan=math.inf).median()
    cameras = K1.expand_as(F_parts), K2.expand_as(F_parts)
    R, t = relative_pose(F_mat[None], *(value[:1] for value in (*cameras, x1, x2)))
    R_parts, t_parts = relative_pose(F_parts, *cameras, x1, x2)
    angles = pose_error(R_parts, t_parts, R.expand_as(R_parts), t.expand_as(t_parts))
    return _scale_to_all(distance, angles.nan_to_num(nan=180.0), size, len(points1))


def predict_transfer_error(
    H_parts: Tensor, size: int, points1: Tensor, H_mat: Tensor, inliers: Tensor, angles: Tensor | None = None
) -> PredictedError:
    """Return the standard errors of points that ``H_mat`` moves, and of its pose.

    The latter is that of the angles (P,) to the poses of parts, zero without them. Other arguments are as for
    :func:`predict_error`.
    """
    x1 = points1[inliers]
    distance = parallax(x1, transform_points(H_mat[None], x1[None])[0], H_parts).median()
    return _scale_to_all(distance, distance.new_zeros(1) if angles is None else angles, size, len(points1))


def _scale_to_all(distance: Tensor, angles: Tensor, size: int, number: int) -> PredictedError:
    """Return the standard errors of all matches from a distance and the angles (P,) to the matrices of parts."""
    unit = math.sqrt(1 / min(number, COMMON_ERRORS) / (1 / size - 1 / number))
    angle = (math.sqrt(size / (number - size)) * angles).clamp(max=180.0).median()
    return PredictedError(unit * float(distance), float(angle))


def nominal_camera(size: Size) -> Tensor:
    """Return the camera (3, 3) of a common lens for an image of a width and height."""
    focal = NOMINAL_FOCAL * max(size)
    return torch.tensor([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]], dtype=torch.float64)


class PairWarning(NamedTuple):
    """A reason to doubt a matrix."""

    code: str  # few_inliers, chance, clustered, planar, unstable, ambiguous, no_pose or cameras
    text: str  # one sentence for people


def find_warnings(
    points1: Tensor, points2: Tensor, inliers: Tensor, threshold: float, size2: Size, angle: float
) -> tuple[PairWarning, ...]:
    """Return the reasons to doubt the matrix of matches (N, 2) with a mask of inliers (N,); none when all is well.

    ``angle`` is that of the :class:`~kornia_learnnorm.two_view.reliability.PredictedError`.
    """
    found, total, matches = {}, int(inliers.sum()), len(inliers)
    if total < MIN_INLIERS:
        found["few_inliers"] = f"only {total} of {matches} matches agree on the matrix"
    if log_false_alarms(matches, total, threshold, size2) > MAX_LOG_FALSE_ALARMS:
        found["chance"] = f"{total} of {matches} matches agree within {threshold:g} px, no more than chance would give"
    spread = min(_spread(points[inliers]) for points in (points1, points2)) / math.hypot(*size2)
    if spread < MIN_SPREAD:
        text = f"the inliers lie close to one line or one point: {spread:.1%} of the image diagonal apart"
        found["clustered"] = text
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

    A search tries 50,000 samples of eight, far fewer than all that :func:`log_false_alarms` counts. A true matrix with
    too few inliers to be told from all those can have more than a search among random matches finds.
    """
    others = max(0, inliers - SAMPLE_SIZE)
    samples = SEARCH_SAMPLES * math.comb(max(0, matches - SAMPLE_SIZE), others)
    return math.log10(max(1, samples)) + others * _log_strip(threshold, size)


def _log_strip(threshold: float, size: Size) -> float:
    """Return log10 of a bound on the share of an image within a threshold (pixels) of a line."""
    return math.log10(min(1.0, 2 * threshold * math.hypot(*size) / math.prod(size)))
