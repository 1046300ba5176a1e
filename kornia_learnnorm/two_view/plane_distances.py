r"""How far matches are from a plane, where the lens may bend it.

The distortion of a lens moves the points of a plane away from its homography, along lines that meet in one point, as
parallax would. What one distortion of both images explains is therefore no evidence of parallax.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.estimators.optimize import RobustCost, minimize
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.models.contract import Residuals

__all__ = ["distances_from_plane"]

MAX_DISTORTION = 0.2  # of the radius at the corners of an image
MAX_STEPS = 10  # of Levenberg-Marquardt
TOLERANCE = 1e-6  # cosine of offsets and derivatives at which it has converged
AT_INFINITY = 1e6  # halves of the diagonal; offset of a point that the homography moves to infinity


def distances_from_plane(
    points1: Tensor, points2: Tensor, H: Tensor, size1: Size, size2: Size, threshold: float
) -> Tensor:
    r"""Return the distances (N,) of points2 from where the plane and a radial distortion move points1, pixels.

    A point at the radius :math:`r` from the centre of its image, in halves of the diagonal, is that of a pinhole camera
    at the radius :math:`r (1 + k r^2)`. The homography and the :math:`k` of both images minimise Geman and McClure's
    loss, from the given homography and no distortion on; :math:`|k| \le 0.2`.

    Args:
        points1: pixels in image 1 with shape :math:`(N, 2)`, float64.
        points2: pixels in image 2 with shape :math:`(N, 2)`; the distance is infinite where the homography moves a
            point to infinity.
        H: homography of the plane with shape :math:`(3, 3)`, from image 1 to image 2.
        size1: width and height of image 1, pixels.
        size2: width and height of image 2, pixels.
        threshold: scale of the loss, pixels.

    """
    T1, T2 = _from_pixels(size1), _from_pixels(size2)
    ones = torch.ones_like(points1.mT[:1])
    x1, x2 = (T @ torch.cat([points.mT, ones]) for T, points in ((T1, points1), (T2, points2)))
    H = T2 @ H @ torch.linalg.inv(T1)
    start = _Parameters(torch.cat([(H / torch.linalg.matrix_norm(H)).flatten(), H.new_zeros(1)])[None])
    cost = RobustCost(_BentPlane(), x1[None], x2[None], ones, GemanMcClure(threshold * float(T2[0, 0])))
    _, optimum = minimize(cost, start, MAX_STEPS, TOLERANCE)
    distance = cost.squares(optimum.state.matrix())[0].sqrt()
    return torch.where(distance < AT_INFINITY, distance / T2[0, 0], math.inf)


class _Parameters(NamedTuple):
    """Nine entries of a homography, and a distortion as a share of its bound, through artanh, (1, 10)."""

    values: Tensor

    def matrix(self) -> Tensor:
        return self.values

    def retract(self, step: Tensor) -> _Parameters:
        return _Parameters(self.values + step)

    def tangents(self) -> Tensor:
        return torch.eye(10).to(self.values)[None]


class _BentPlane(Residuals):
    """Homographies of images with one radial distortion, by ten parameters."""

    components = 2

    def linearise(self, M: Tensor, x1: Tensor, x2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the offsets (1, 2 N) of x2 from where x1 is moved, and their derivatives (1, 10, 2 N).

        Those of a point that is moved to infinity are zero, so that it does not count.
        """
        H, bend = M[0, :9].view(3, 3), torch.tanh(M[0, 9])
        k, slope = MAX_DISTORTION * bend, MAX_DISTORTION * (1 - bend.square())
        u1, u2 = x1[0, :2], x2[0, :2]
        square1, square2 = u1.square().sum(0), u2.square().sum(0)
        ideal1 = torch.cat([u1 * (1 + k * square1), x1[0, 2:]])
        moved = H @ ideal1
        v, by_point = moved[:2] / moved[2], ideal1 / moved[2]
        # Over the local scale: a distortion that shrinks an image must not shrink its errors.
        stretch = 1 + 2 * k * square2
        offsets = (v - u2 * (1 + k * square2)) / stretch
        zero = torch.zeros_like(by_point)
        rows = [torch.cat([by_point, zero, -v[0] * by_point]), torch.cat([zero, by_point, -v[1] * by_point])]
        by_k = (H[:2, :2] @ (u1 * square1) - v * (H[2, :2] @ (u1 * square1))) / moved[2]
        by_k = (by_k - u2 * square2 - 2 * square2 * offsets) / stretch
        J = torch.cat([torch.stack(rows, 1) / stretch, slope * by_k[None]])
        finite = (J.isfinite().all(0) & offsets.isfinite()).all(0)
        offsets, J = torch.where(finite, offsets, AT_INFINITY), torch.where(finite, J, 0.0)
        return offsets.flatten()[None], J.flatten(1)[None]


def _from_pixels(size: Size) -> Tensor:
    """Return the transform (3, 3) from pixels to halves of the diagonal, from the centre."""
    radius = math.hypot(*size) / 2
    x, y = (side / 2 / radius for side in size)
    return torch.tensor([[1 / radius, 0, -x], [0, 1 / radius, -y], [0, 0, 1]], dtype=torch.float64)
