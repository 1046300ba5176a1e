"""Reasons to doubt the cameras of an image pair: matches that contradict them, and those of another image size."""

import math

import torch
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.estimators.refinement import refine_essential, refine_fundamental
from kornia_learnnorm.estimators.robust_losses import GemanMcClure
from kornia_learnnorm.geometry.distances import sampson_distance
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.local_optimization import FINAL_LOSS_SCALE
from kornia_learnnorm.two_view.inputs import Cameras
from kornia_learnnorm.two_view.pair_warnings import PairWarning
from kornia_learnnorm.two_view.predicted_error import MEDIAN_SQUARE, MIN_NOISE

MIN_MISFIT = 5e-5  # of the largest coordinate, about the longer side; photographs called undistorted have up to 3e-5
MAX_LOG_CHANCE = -3.0  # log10 of the probability that noise alone adds as much
CONTRADICTION = "the matches contradict K1 and K2"
MAX_OFFSET = 0.2  # of both sides of an image; a principal point is closer to the centre


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
    for name, K, size in zip(("K1", "K2"), cameras, sizes, strict=True):
        if size is None:
            continue
        x, y = centre = K[:2, 2] / K[2, 2] / torch.tensor(size)
        offset = (centre - 0.5).abs()
        if bool((offset > 0.5).any() or (offset > MAX_OFFSET).all()):
            text = f"the principal point of {name} is at {x:.0%} of the width and {y:.0%} of the height of its image"
            return (PairWarning("cameras", f"{text}: {name} may be that of another image size"),)
    if F_mat is None:
        return ()
    misfit, log_chance = camera_misfit(points1, points2, F_mat, threshold, cameras)
    if misfit < MIN_MISFIT * float(points2.max()) or log_chance > MAX_LOG_CHANCE:
        return ()
    return (PairWarning("cameras", f"{CONTRADICTION}, which add {misfit:.2f} px to their epipolar distances"),)


def drop_contradiction(warnings: tuple[PairWarning, ...]) -> tuple[PairWarning, ...]:
    """Return the warnings without that of matches that contradict their cameras."""
    return tuple(warning for warning in warnings if not warning.text.startswith(CONTRADICTION))


def camera_misfit(
    points1: Tensor, points2: Tensor, F_mat: Tensor, threshold: float, cameras: Cameras
) -> tuple[float, float]:
    """Return the root mean square distance that cameras add to matches (N, 2), pixels, and log10 of its probability.

    It is the difference between the essential matrix next to F_mat (3, 3) and the fundamental matrix next to it. Only
    matches that agree with the cameras count, and the median must grow as much as the mean: false matches may agree on
    another matrix. Noise alone makes the likelihood ratio of both matrices twice an F-distributed number of 2, for as
    many more parameters, and :math:`m` degrees of freedom: it is above :math:`2x` with probability
    :math:`(1 + 2x / m)^{-m / 2}`.
    """
    x1, x2, loss = points1[None], points2[None], GemanMcClure(FINAL_LOSS_SCALE * threshold)
    E_mat = (cameras[1].mT @ F_mat @ cameras[0])[None]
    near = sampson_distance(x1, x2, refine_essential(x1, x2, E_mat, *cameras, loss=loss).F_mat)[0] < threshold
    freedom = int(near.sum()) - Fundamental.dof
    if freedom < 2:
        return 0.0, 0.0
    x1, x2 = x1[:, near], x2[:, near]
    tied = refine_essential(x1, x2, E_mat, *cameras, loss=loss)
    free = refine_fundamental(x1, x2, tied.F_mat, loss=loss)
    median1, median2 = (float(sampson_distance(x1, x2, F)[0].square().median()) for F in (tied.F_mat, free.F_mat))
    added = max(0.0, float(tied.cost - free.cost)) / freedom
    noise = max(median2 / MEDIAN_SQUARE, (MIN_NOISE * threshold) ** 2)
    misfit = min(added, max(0.0, median1 - median2) / MEDIAN_SQUARE)
    return math.sqrt(misfit), -freedom / 2 * math.log10(1 + added / noise)
