"""Measure how far matches contradict their given cameras: inexact intrinsics, or a lens distortion."""

import math
from typing import Any, NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.estimators.refinement import refine_essential, refine_fundamental
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.geometry.distances import sampson_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.metrics.poses import pose_error
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.fits import LOSS_SCALE
from kornia_learnnorm.two_view.input_checks import Cameras
from kornia_learnnorm.two_view.predicted_error import MEDIAN_SQUARE, MIN_NOISE

NEAR_BENT, MAX_BENT = 3.0, 1000  # thresholds, and number, of the matches to which a distortion is fitted
# Grids of distortions, from strong pincushion to wide-angle lenses, and around the best: shares of its radius by which
# undistortion moves the outermost point.
BENDS, FINER = torch.arange(-1, 7, dtype=torch.float64) / 10, torch.arange(-3, 4, dtype=torch.float64) / 40
PINHOLE = 1  # index of no distortion in BENDS


class Misfit(NamedTuple):
    """What cameras cost the matches, compared with a model of more parameters."""

    distance: float  # root mean square distance that they add, pixels
    log_chance: float  # log10 of the probability that noise alone adds as much
    angle: float  # by which they change rotation or translation, degrees


class _Fit(NamedTuple):
    cost: float
    F_mat: Tensor  # (1, 3, 3)
    points1: Tensor  # (1, N, 2)
    points2: Tensor


def camera_misfit(points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float, cameras: Cameras) -> Misfit:
    """Return what cameras cost matches (N, 2), compared with none.

    It compares the essential matrix refined from F_mat (3, 3) with the fundamental matrix refined from that. Only
    matches that agree with the cameras count.
    """
    x1, x2, loss = points1[None], points2[None], GemanMcClure(LOSS_SCALE * threshold)
    E_mat = (cameras[1].mT @ F_mat @ cameras[0])[None]
    near = sampson_distance(x1, x2, refine_essential(x1, x2, E_mat, *cameras, loss=loss).F_mat)[0] < threshold
    x1, x2, freedom = x1[:, near], x2[:, near], int(near.sum()) - Fundamental.dof
    if freedom < 2:
        return Misfit(0.0, 0.0, 0.0)
    tied = refine_essential(x1, x2, E_mat, *cameras, loss=loss)
    free = refine_fundamental(x1, x2, tied.F_mat, loss=loss)
    tied_fit, free_fit = (_Fit(float(found.cost), found.F_mat, x1, x2) for found in (tied, free))
    return _compare(tied_fit, free_fit, freedom, threshold, cameras)


def lens_misfit(
    points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float, cameras: Cameras
) -> tuple[Misfit, float]:
    r"""Return what pinhole cameras cost matches (N, 2), compared with a radial distortion, and its k1 in OpenCV.

    A point at the radius :math:`r` from the principal point, in focal lengths, is that of a pinhole camera at
    :math:`r (1 + k r^2)`. One :math:`k` for both views is searched on a grid; if the best is the largest or the
    smallest, the misfit is zero.
    """
    near = (sampson_distance(points1[None], points2[None], F_mat[None])[0] < NEAR_BENT * threshold).nonzero()[:, 0]
    near = near[:: 1 + len(near) // MAX_BENT]
    freedom = len(near) - Essential.dof - 1
    if freedom < 2:
        return Misfit(0.0, 0.0, 0.0), 0.0
    views, loss = (points1[near], points2[near]), GemanMcClure(LOSS_SCALE * threshold)
    cameras = cameras[0] / cameras[0][2, 2], cameras[1] / cameras[1][2, 2]
    rays = [convert_points_to_homogeneous(x) @ torch.linalg.inv(K).mT for x, K in zip(views, cameras, strict=True)]
    squares = [ray[:, :2].square().sum(-1, keepdim=True) for ray in rays]
    largest = float(torch.cat(squares).max())
    offsets = [s / largest * (x - K[:2, 2]) for s, x, K in zip(squares, views, cameras, strict=True)]
    E_mat = (cameras[1].mT @ F_mat @ cameras[0]).expand(len(BENDS), 3, 3)

    def refine(bends: Tensor) -> list[_Fit]:
        bent = [x + bends[:, None, None] * offset for x, offset in zip(views, offsets, strict=True)]
        options: dict[str, Any] = {"loss": loss, "max_iterations": 15, "tolerance": 1e-3}
        found = refine_essential(bent[0], bent[1], E_mat[: len(bends)], *cameras, **options)
        rows = zip(found.cost.tolist(), *(values[:, None] for values in (found.F_mat, *bent)), strict=True)
        return [_Fit(*row) for row in rows]

    coarse = refine(BENDS)
    bends = BENDS[min(range(len(BENDS)), key=lambda row: coarse[row].cost)] + FINER
    fine = refine(bends)
    best = min(range(len(bends)), key=lambda row: fine[row].cost)
    # A point that undistortion moves from r to r (1 + b) goes back by the factor 1 + k1 r^2 (1 + b)^2.
    bend, tied = float(bends[best]), coarse[PINHOLE]
    if not BENDS[0] < bend < BENDS[-1]:  # at an end of the grid: no distortion
        return Misfit(0.0, 0.0, 0.0), 0.0
    misfit = _compare(tied, fine[best], freedom, threshold, cameras)
    misfit = misfit._replace(angle=_pose_angle(tied._replace(F_mat=F_mat[None]), fine[best], cameras))
    return misfit, -bend / (largest * (1 + bend) ** 3)


def _compare(tied: _Fit, free: _Fit, freedom: int, threshold: float, cameras: Cameras) -> Misfit:
    """Return what the cameras of one fit cost the matches, compared with another one.

    The median distance must grow as much as the mean: false matches may agree on another matrix. Noise alone makes the
    likelihood ratio of both matrices twice an F-distributed number of 2, for as many more parameters, and :math:`m`
    degrees of freedom: it is above :math:`2x` with probability :math:`(1 + 2x / m)^{-m / 2}`.
    """
    medians = [float(sampson_distance(fit.points1, fit.points2, fit.F_mat).square().median()) for fit in (tied, free)]
    added = max(0.0, tied.cost - free.cost) / freedom
    noise = max(medians[1] / MEDIAN_SQUARE, (MIN_NOISE * threshold) ** 2)
    misfit = min(added, max(0.0, medians[0] - medians[1]) / MEDIAN_SQUARE)
    return Misfit(math.sqrt(misfit), -freedom / 2 * math.log10(1 + added / noise), _pose_angle(tied, free, cameras))


def _pose_angle(first: _Fit, second: _Fit, cameras: Cameras) -> float:
    """Return the larger angle between the rotations or the directions of translation of two fits, degrees."""
    K1, K2 = (K[None] for K in cameras)
    (R1, t1), (R2, t2) = (relative_pose(fit.F_mat, K1, K2, fit.points1, fit.points2) for fit in (first, second))
    return float(pose_error(R1, t1, R2, t2).nan_to_num(nan=180.0, posinf=180.0))
