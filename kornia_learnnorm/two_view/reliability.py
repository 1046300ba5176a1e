r"""Whether the matches of an image pair determine their fundamental matrix, and how far off it may be.

Nothing here needs a ground truth: the matches themselves, solved again on random parts of them, are the evidence.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.data.images import import_cv2
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.ransac.samplers import SAMPLE_SIZE
from kornia_learnnorm.two_view.parallax import parallax, parallax_evidence

__all__ = [
    "MIN_MUTUAL_SHARE",
    "PairWarning",
    "Stability",
    "assess",
    "choose_found",
    "find_homography",
    "log_false_alarms",
    "log_false_samples",
    "measure_stability",
    "mutual_share",
    "nominal_camera",
    "random_parts",
]

NUM_PARTS = 12  # random parts of the matches that are solved again
PART_INLIERS = 48  # expected in a part, where these are more than half and less than four fifths of all inliers
MIN_SUPPORT = 0.75  # of the inliers; the matrix of a part with fewer is that of a search that failed
MIN_FOUND = 4  # parts; with fewer matrices of as much support, all of them count
MAX_ANGLE = 8.0  # degrees; a pose that moves by more in half of the parts is unstable
NOMINAL_FOCAL = 1.2  # of the longer image side: focal length where no camera is given
MIN_INLIERS = 16  # with fewer, no estimate of the error is reliable either
MIN_SPREAD = 0.02  # of the image diagonal; standard deviation of the inliers across their longest direction
SEARCH_SAMPLES = 50_000  # minimal samples of a search that finds nothing
MAX_LOG_FALSE_ALARMS = -2.0  # log10 of the expected number of random models with as much support
MIN_PLANAR_SHARE = 0.5  # of the inliers on one homography; below, the scene is no plane
PARALLAX_SCALES = (1.0, 0.5, 0.25, 0.125)  # of the threshold at which parallax is sought; SIFT errs by 0.1 px or so
MAX_LOG_CHANCE_PARALLAX = -3.0  # log10 of the expected number of epipoles that chance gives as much parallax
MIN_MUTUAL_SHARE = 0.85  # of the matches off the plane that fit; below, false ones may agree with each other
COMMON_ERRORS = 400  # matches beyond which more do not help: the errors of neighbours are alike
MIN_MOTION = 0.1  # pixels, median over the matches; below, the camera has not moved


class PairWarning(NamedTuple):
    """A reason to doubt a fundamental matrix.

    Attributes:
        code: one word for programs: ``few_inliers``, ``chance``, ``clustered``, ``planar``, ``unstable``,
            ``ambiguous`` or ``no_pose``.
        text: one sentence for people.
    """

    code: str
    text: str


class Stability(NamedTuple):
    """How far the matrices of random parts of the matches are from the matrix of all, as standard errors of the latter.

    A part of m of N matches, drawn without replacement, differs from all of them with N / m - 1 times the variance of
    the latter (delete-d jackknife: J. Shao, C. Wu, A general theory for jackknife variance estimation, Annals of
    Statistics 1989). Errors of neighbouring matches are alike, so no more than 400 of them count.

    Attributes:
        error: median symmetric epipolar distance under the matrices of the parts of correspondences that fit the matrix
            of all, pixels.
        angle: median over the parts of the larger angle between the rotations and between the directions of
            translation, degrees.
    """

    error: float
    angle: float


def random_parts(number: int, inliers: int, seed: int) -> Tensor:
    """Return the rows (P, M) of random parts of the matches: half of them, or so many that 48 inliers are expected.

    Args:
        number: number of matches.
        inliers: number of inliers among them.
        seed: seed of the parts.
    """
    share = min(max(0.5, PART_INLIERS / max(1, inliers)), 0.8)
    size = min(max(8, round(share * number)), number - 1)
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randperm(number, generator=generator)[:size] for _ in range(NUM_PARTS)])


def choose_found(F_parts: Tensor, support: Tensor, inliers: int) -> Tensor:
    """Return the matrices of parts that most inliers agree with; all of them where these are few.

    Among many outliers the search in a part can fail. Its matrix has little support among all matches then, and says
    nothing about how well the inliers determine theirs, unlike another matrix with as much support.

    Args:
        F_parts: matrices of the parts, (P, 3, 3).
        support: number of all matches that agree with each, (P,).
        inliers: number that agree with the matrix of all.
    """
    found = support >= MIN_SUPPORT * inliers
    return F_parts[found] if int(found.sum()) >= MIN_FOUND else F_parts


def measure_stability(
    F_parts: Tensor, size: int, points1: Tensor, points2: Tensor, F_mat: Tensor, inliers: Tensor, K1: Tensor, K2: Tensor
) -> Stability:
    """Return how far the matrices of random parts of the matches differ from ``F_mat``.

    Args:
        F_parts: matrices of the parts of :func:`random_parts`, (P, 3, 3); zeros where there is none.
        size: matches in a part.
        points1: pixels of all matches in image 1, (N, 2), float64.
        points2: pixels of all matches in image 2, (N, 2).
        F_mat: matrix of all matches, (3, 3).
        inliers: mask of its inliers, (N,).
        K1: camera of image 1, (3, 3), or a guess.
        K2: camera of image 2, (3, 3), or a guess.
    """
    unit = math.sqrt(1 / min(len(points1), COMMON_ERRORS) / (1 / size - 1 / len(points1)))
    x1 = points1[inliers].expand(len(F_parts), -1, -1)
    x2 = _onto_lines(points1[inliers], points2[inliers], F_mat).expand(len(F_parts), -1, -1)
    error = symmetric_epipolar_distance(x1, x2, F_parts).nan_to_num(nan=math.inf).median()
    R, t = _poses(F_mat[None], x1, x2, K1, K2)
    R_parts, t_parts = _poses(F_parts, x1, x2, K1, K2)
    angles = pose_error(R_parts, t_parts, R.expand_as(R_parts), t.expand_as(t_parts))
    independent = math.sqrt(size / (len(points1) - size))
    angle = (independent * angles.nan_to_num(nan=180.0)).clamp(max=180.0).median()
    return Stability(unit * float(error), float(angle))


def _onto_lines(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    """Return points2 (N, 2) moved onto their epipolar lines."""
    line = convert_points_to_homogeneous(points1) @ F_mat.mT
    normal = line[:, :2]
    distance = ((normal * points2).sum(-1) + line[:, 2]) / normal.square().sum(-1)
    return points2 - distance[:, None] * normal


def _poses(F_mat: Tensor, x1: Tensor, x2: Tensor, K1: Tensor, K2: Tensor) -> tuple[Tensor, Tensor]:
    """Return the relative poses (B, 3, 3) and (B, 3) of matrices (B, 3, 3) of one pair; NaN where there is none."""
    number = len(F_mat)
    return relative_pose(F_mat, K1.expand(number, 3, 3), K2.expand(number, 3, 3), x1[:number], x2[:number])


def nominal_camera(size: tuple[int, int]) -> Tensor:
    """Return the camera (3, 3) of a common lens for an image of a width and height."""
    focal = NOMINAL_FOCAL * max(size)
    return torch.tensor([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]], dtype=torch.float64)


def find_homography(points1: Tensor, points2: Tensor, threshold: float) -> Tensor | None:
    """Return the homography (3, 3) that explains most matches within a threshold (pixels), by OpenCV's MAGSAC."""
    cv2 = import_cv2()
    try:
        H = cv2.findHomography(points1.numpy(), points2.numpy(), cv2.USAC_MAGSAC, threshold)[0]
    except cv2.error:  # OpenCV 4 raises when too few points are left to sample from
        H = None
    return None if H is None or not np.isfinite(H).all() else torch.from_numpy(H).double()


def assess(
    points1: Tensor,
    points2: Tensor,
    distance: Tensor,
    off_plane: Tensor | None,
    threshold: float,
    size2: tuple[int, int],
    stability: Stability,
) -> tuple[PairWarning, ...]:
    """Return the reasons to doubt the matrix of a pair; none when all is well.

    Args:
        points1: pixels of all matches in image 1, (N, 2), float64.
        points2: pixels of all matches in image 2, (N, 2).
        distance: symmetric epipolar distances of the matches to the matrix, (N,), pixels.
        off_plane: distances of the matches from the plane that explains most inliers, pixels, (N,), or None; see
            :func:`~kornia_learnnorm.two_view.plane_distances.distances_from_plane`.
        threshold: largest distance of an inlier, pixels.
        size2: width and height of image 2.
        stability: of the matrix, see :func:`measure_stability`.
    """
    inliers = distance < threshold
    found, total, matches = [], int(inliers.sum()), len(inliers)
    if total < MIN_INLIERS:
        found.append(PairWarning("few_inliers", f"only {total} of {matches} matches agree on the matrix"))
    if log_false_alarms(matches, total, threshold, size2) > MAX_LOG_FALSE_ALARMS:
        text = f"{total} of {matches} matches agree within {threshold:g} px, no more than chance would give"
        found.append(PairWarning("chance", text))
    spread = min(_spread(points[inliers]) for points in (points1, points2)) / math.hypot(*size2)
    if spread < MIN_SPREAD:
        text = f"the inliers lie close to one line or one point: {spread:.1%} of the image diagonal apart"
        found.append(PairWarning("clustered", text))
    if off_plane is not None:
        found += _check_plane(off_plane, distance, threshold)
    if stability.angle > MAX_ANGLE:
        text = f"the pose changes by {stability.angle:.0f} degrees when the matches are drawn anew"
        found.append(PairWarning("unstable", text))
    return tuple(found)


def _check_plane(off_plane: Tensor, distance: Tensor, threshold: float) -> list[PairWarning]:
    """Return a warning where most inliers lie on a plane and the parallax of the others is no more than chance.

    Args:
        off_plane: distances of the matches from the plane, (N,), pixels.
        distance: symmetric epipolar distances, (N,), pixels.
        threshold: largest distance of an inlier, pixels.
    """
    shares = [float((off_plane[distance < threshold] < scale * threshold).double().mean()) for scale in (1, 3)]
    evidence = min(
        parallax_evidence(off_plane, distance < scale * threshold, scale * threshold) for scale in PARALLAX_SCALES
    )
    if shares[1] <= MIN_PLANAR_SHARE or evidence <= MAX_LOG_CHANCE_PARALLAX:
        return []
    text = (
        f"one homography explains {shares[0]:.0%} of the inliers within {threshold:g} px and {shares[1]:.0%} within "
        f"{3 * threshold:g} px (a plane, or a camera that only rotates), and the rest do not determine the epipole"
    )
    return [PairWarning("planar", text)]


def mutual_share(points1: Tensor, points2: Tensor, mutual: Tensor, F_mat: Tensor, threshold: float) -> float:
    """Return which share of the nearest neighbours that fit a matrix are nearest neighbours in both directions.

    Nearly all true matches are, and far fewer of the false ones. The reverse match has no part in which matches fit, so
    a low share means false matches that agree with each other. Only matches off the plane that explains most count,
    since they determine the epipole.
    """
    fits = symmetric_epipolar_distance(points1, points2, F_mat) < threshold
    H = find_homography(points1[fits], points2[fits], threshold) if int(fits.sum()) >= 8 else None
    if H is not None:
        fits &= parallax(points1, points2, H) > 3 * threshold
    return float(mutual[fits].double().mean()) if int(fits.sum()) >= MIN_INLIERS else 1.0


def _spread(points: Tensor) -> float:
    """Return the standard deviation of points (N, 2) across the direction in which they spread most, pixels."""
    return float(torch.linalg.svdvals(points - points.mean(0))[-1]) / math.sqrt(len(points))


def log_false_alarms(matches: int, inliers: int, threshold: float, size: tuple[int, int]) -> float:
    """Return log10 of the expected number of matrices with as many inliers among random matches.

    L. Moisan, B. Stival, A probabilistic criterion to detect rigid point matches between two images and estimate the
    fundamental matrix, IJCV 2004: models from seven matches, and the probability that a random point lies within the
    threshold of a line.

    Args:
        matches: number of matches.
        inliers: number of inliers.
        threshold: largest distance of an inlier, pixels.
        size: width and height of image 2, pixels.
    """
    strip = _strip(threshold, size)
    tests = max(1, matches - 7) * math.comb(matches, inliers) * math.comb(inliers, 7)
    return math.log10(max(1, tests)) + (inliers - 7) * math.log10(strip)


def log_false_samples(matches: int, inliers: int, threshold: float, size: tuple[int, int]) -> float:
    """Return log10 of the expected number of a search's samples with as many inliers among random matches.

    A search tries 50,000 samples of eight, far fewer than all that :func:`log_false_alarms` counts. A true matrix with
    too few inliers to be told from all those can have more than a search among random matches finds. Arguments are
    those of :func:`log_false_alarms`.
    """
    others = max(0, inliers - SAMPLE_SIZE)
    samples = SEARCH_SAMPLES * math.comb(max(0, matches - SAMPLE_SIZE), others)
    return math.log10(max(1, samples)) + others * math.log10(_strip(threshold, size))


def _strip(threshold: float, size: tuple[int, int]) -> float:
    """Return a bound on the share of an image within a threshold (pixels) of a line."""
    return min(1.0, 2 * threshold * math.hypot(*size) / math.prod(size))
