"""The predicted error of a matrix, from the matrices of random subsets of the matches."""

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
from kornia_learnnorm.two_view.parallax import parallax

NOMINAL_FOCAL = 1.2  # of the longer image side: focal length where no camera is given
COMMON_ERRORS = 400  # matches beyond which more do not help: the errors of neighbours are alike
MEDIAN_SQUARE = 0.455  # of a standard normal variable
MIN_NOISE = 1e-6  # thresholds; of matches without noise
CAMERA_ERROR = 1e-4  # of the longer image side, in photographs: errors that matches do not reveal, such as distortion


class PredictedError(NamedTuple):
    """Standard errors of a fundamental matrix or a homography."""

    distance: float  # median symmetric epipolar distance, or distance in image 2 of points moved by H, pixels
    angle: float  # larger angle of the rotations and of the directions of translation, degrees


def predict_error(
    F_parts: Tensor, size: int, points1: Tensor, points2: Tensor, F_mat: Tensor, inliers: Tensor, K1: Tensor, K2: Tensor
) -> PredictedError:
    """Return the standard errors of ``F_mat`` from its distance to the matrices of random subsets of the matches.

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
    distance = symmetric_epipolar_distance(x1, x2, F_parts).nan_to_num(nan=math.inf).median()
    return _scale_to_all(distance, pose_angles(F_mat, F_parts, x1, x2, K1, K2), size, len(points1))


def pose_angles(F_mat: Tensor, others: Tensor, points1: Tensor, points2: Tensor, K1: Tensor, K2: Tensor) -> Tensor:
    """Return the angles (P,) from the pose of ``F_mat`` (3, 3) to those of ``others`` (P, 3, 3), degrees.

    Each is the larger one of the rotations and of the directions of translation; of the four poses of a matrix, that
    with most of the matches (N, 2) in front of the cameras counts, and 180 degrees for a matrix without a pose.
    """
    matrices = torch.cat([F_mat[None], others])
    R, t = relative_pose(matrices, *(value.expand(len(matrices), -1, -1) for value in (K1, K2, points1, points2)))
    return pose_error(R[1:], t[1:], R[:1], t[:1]).nan_to_num(nan=180.0, posinf=180.0)


def predict_transfer_error(
    H_parts: Tensor, size: int, points1: Tensor, H_mat: Tensor, inliers: Tensor, angles: Tensor | None = None
) -> PredictedError:
    """Return the standard errors of points that ``H_mat`` moves, and of its pose.

    The error of the pose is computed from the angles (P,) to the poses of parts, zero without them. Other arguments are
    those of :func:`predict_error`.
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
