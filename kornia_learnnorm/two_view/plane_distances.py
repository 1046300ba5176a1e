r"""How far matches are from a plane, where the lens may bend it.

The distortion of a lens moves the points of a plane away from its homography, along lines that meet in one point, as
parallax would. What one distortion of both images explains is therefore no evidence of parallax.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

__all__ = ["distances_from_plane"]

MAX_DISTORTION = 0.2  # of the radius at the corners of an image
STEPS = 10  # of Levenberg-Marquardt
FIRST_DAMPING = 1e-6  # of the mean diagonal entry of the normal matrix


def distances_from_plane(
    points1: Tensor, points2: Tensor, H: Tensor, size1: tuple[int, int], size2: tuple[int, int], threshold: float
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
    centre1, radius1 = _centre_and_radius(size1)
    centre2, radius2 = _centre_and_radius(size2)
    linearise = partial(_linearise, u1=(points1 - centre1) / radius1, u2=(points2 - centre2) / radius2)
    H = torch.linalg.inv(_to_pixels(centre2, radius2)) @ H @ _to_pixels(centre1, radius1)
    start = torch.cat([(H / torch.linalg.matrix_norm(H)).flatten(), H.new_zeros(1)])
    distance: Tensor = radius2 * _minimize(linearise, start, threshold / radius2).norm(dim=-1)
    return distance.nan_to_num(nan=math.inf)


def _linearise(parameters: Tensor, u1: Tensor, u2: Tensor) -> tuple[Tensor, Tensor]:
    """Return the offsets (N, 2) of u2 and their derivatives by the entries of H and the distortion, (N, 2, 10)."""
    H, bend = parameters[:9].view(3, 3), torch.tanh(parameters[9])  # the distortion is bounded
    k, slope = MAX_DISTORTION * bend, MAX_DISTORTION * (1 - bend.square())
    square1, square2 = (u.square().sum(-1, keepdim=True) for u in (u1, u2))
    ideal1 = convert_points_to_homogeneous(u1 * (1 + k * square1))
    moved = ideal1 @ H.mT
    depth, v = moved[:, 2:], moved[:, :2] / moved[:, 2:]
    # Over the local scale: a distortion that shrinks an image must not shrink its errors.
    stretch = 1 + 2 * k * square2
    offsets = (v - u2 * (1 + k * square2)) / stretch
    by_point, zero = ideal1 / depth, torch.zeros_like(ideal1)
    rows = [torch.cat([by_point, zero, -v[:, :1] * by_point], 1), torch.cat([zero, by_point, -v[:, 1:] * by_point], 1)]
    by_k = ((u1 * square1) @ H[:2, :2].mT - v * ((u1 * square1) @ H[2, :2])[:, None]) / depth
    by_k = (by_k - u2 * square2 - 2 * square2 * offsets) / stretch
    return offsets, torch.cat([torch.stack(rows, 1) / stretch[..., None], slope * by_k[..., None]], -1)


def _minimize(linearise: Callable[[Tensor], tuple[Tensor, Tensor]], start: Tensor, scale: float) -> Tensor:
    """Return the residuals (N, 2) after steps of Levenberg-Marquardt on Geman and McClure's loss from (P,) on."""
    parameters, damping, eye = start, FIRST_DAMPING, torch.eye(len(start), dtype=start.dtype)
    residual, J = linearise(start)
    for _ in range(STEPS):
        usable = J.isfinite().all(-1).all(-1) & residual.isfinite().all(-1)
        weights = (1 + residual[usable].square().sum(-1) / scale**2).pow(-2)
        weighted = (weights[:, None, None] * J[usable]).flatten(0, 1)
        normal = weighted.mT @ J[usable].flatten(0, 1)
        damped = normal + damping * normal.diagonal().mean() * eye
        tried = parameters - torch.linalg.solve_ex(damped, weighted.mT @ residual[usable].flatten())[0]
        moved, moved_J = linearise(tried)
        if not _cost(moved, scale) < _cost(residual, scale):  # or NaN
            damping *= 10
            continue
        parameters, residual, J, damping = tried, moved, moved_J, damping / 10
    return residual


def _cost(offsets: Tensor, scale: float) -> Tensor:
    """Return the sum of Geman and McClure's losses; those of points at infinity are one."""
    square = offsets.square().sum(-1) / scale**2
    return (square / (1 + square)).nan_to_num(nan=1.0).sum()


def _centre_and_radius(size: tuple[int, int]) -> tuple[Tensor, float]:
    """Return the centre (2,) of an image and the half of its diagonal, pixels."""
    return torch.tensor(size, dtype=torch.float64) / 2, math.hypot(*size) / 2


def _to_pixels(centre: Tensor, radius: float) -> Tensor:
    """Return the transform (3, 3) from halves of the diagonal, from the centre, to pixels."""
    return torch.cat([torch.cat([radius * torch.eye(2).double(), centre[:, None]], 1), torch.eye(3)[2:].double()])
