r"""The poses of two calibrated cameras that a homography allows: those of a plane, or a rotation.

In normalised coordinates the homography of the plane :math:`n^\top X_1 = d` is :math:`R + t n^\top / d` up to scale,
:math:`R` where the camera only rotates.
"""

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import cross_product_matrix
from kornia.metrics import angle_error_mat
from torch import Tensor

from kornia_learnnorm.data.images import import_cv2
from kornia_learnnorm.geometry.matrices import determinant, unit_matrix
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.metrics.poses import pose_error

MIN_BASELINE = 0.01  # of the distance to the plane; inexact cameras explain less
MIN_IN_FRONT = 0.95  # of the points, under a pose that they allow


class PlanePose(NamedTuple):
    """A pose :math:`X_2 = R X_1 + t` and the plane that is seen; without t and n where the camera only rotates."""

    R: Tensor  # (3, 3)
    t: Tensor | None = None  # unit vector (3,)
    n: Tensor | None = None  # unit normal (3,) of the plane in coordinates of camera 1, n^T X1 > 0

    def essential(self) -> Tensor:
        r"""Return the essential matrix (3, 3) :math:`[t]_\times R` of unit Frobenius norm; only with t."""
        return unit_matrix(cross_product_matrix(cast(Tensor, self.t)[None])[0] @ self.R)

    def fundamental(self, K1: Tensor, K2: Tensor) -> Tensor:
        """Return the fundamental matrix (3, 3) of unit Frobenius norm; only with t."""
        return unit_matrix(transform_fundamental(self.essential(), torch.linalg.inv(K1), torch.linalg.inv(K2)))


def plane_poses(H_mat: Tensor, K1: Tensor, K2: Tensor, points1: Tensor, points2: Tensor) -> list[PlanePose]:
    """Return the poses of a homography (3, 3) that matches (N, 2) allow: two or one of a plane, or the rotation.

    A plane has two poses unless points would be behind a camera, none if the homography turns it over. A baseline
    below 1 % of the distance to the plane counts as a rotation. All are in float64, points in pixels.

    Reference:
        E. Malis, M. Vargas, Deeper understanding of the homography decomposition for vision-based control, INRIA
        report 6303, 2007, as OpenCV implements it.
    """
    views = (K1, points1), (K2, points2)
    rays1, rays2 = (torch.linalg.solve(K, convert_points_to_homogeneous(x).mT) for K, x in views)
    M = torch.linalg.solve(K2, H_mat @ K1)
    U, (largest, middle, smallest), Vh = torch.linalg.svd(M)
    sign = ((M @ rays1) * rays2).sum(0).sign().sum().sign()
    if not sign * determinant(M) > 0:
        return []
    if largest - smallest < MIN_BASELINE * middle:
        return [PlanePose(sign * U @ Vh)]
    _, *found = import_cv2().decomposeHomographyMat((sign * M / middle).numpy(), torch.eye(3).double().numpy())
    poses = [[torch.from_numpy(value).squeeze() for value in pose] for pose in zip(*found, strict=True)]
    return [PlanePose(R, t / t.norm(), n) for R, t, n in poses if (n @ rays1 > 0).double().mean() >= MIN_IN_FRONT]


def angle_between(pose: PlanePose, others: Sequence[PlanePose]) -> float:
    """Return the angle, the larger of rotation and translation, from a pose to the nearest of others, degrees."""
    angles = [180.0]
    for other in others:
        if pose.t is not None and other.t is not None:
            angles.append(pose_error(other.R, other.t, pose.R, pose.t).item())
        elif pose.t is other.t:
            angles.append(angle_error_mat(other.R, pose.R).item())
    return min(angles)
