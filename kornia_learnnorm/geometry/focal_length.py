"""The focal lengths of two cameras from a fundamental matrix, where it determines them."""

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.geometry.checks import check_tensor, solve_dtype
from kornia_learnnorm.geometry.matrices import smallest_right_singular_vector, unit_matrix
from kornia_learnnorm.geometry.transforms import affine_transform, transform_fundamental

MAX_SENSITIVITY = 500.0  # of a focal length: its relative change by that of a unit essential matrix, at most


class FocalLengths(NamedTuple):
    """Focal lengths, pixels, NaN and without gradient where they are not determined."""

    focal1: Tensor  # of the first cameras, (B,)
    focal2: Tensor  # of the second cameras, (B,)
    determined: Tensor  # (B,) bool


def focal_lengths(F_mat: Tensor, principal1: Tensor, principal2: Tensor) -> FocalLengths:
    r"""Return the focal lengths that a fundamental matrix gives where principal points are known, in closed form.

    Pixels must be square. They are not determined where both optical axes meet (both cameras look at one point), or an
    epipole is near its principal point (a camera moves forwards).

    Args:
        F_mat: fundamental matrices with shape :math:`(B, 3, 3)`, any scale.
        principal1: principal points of the first images, pixels, with shape :math:`(B, 2)`; the centre of an image is
            a good guess.
        principal2: principal points of the second images.

    Returns:
        focal lengths in the dtype of ``F_mat``, solved in float64 where the device has it, and which are determined.

    Raises:
        TypeError: if a tensor is not floating-point.
        ShapeError: if a shape is wrong.
        ValueError: if the batches differ.

    Reference:
        S. Bougnoux, From projective to Euclidean space under any practical situation, a criticism of self-calibration,
        ICCV 1998.

    Example:
        >>> from kornia_learnnorm.data.synthetic import handheld
        >>> scene = handheld(2, 20, torch.Generator().manual_seed(0))
        >>> found = focal_lengths(scene.F_mat, scene.K1[:, :2, 2], scene.K2[:, :2, 2])
        >>> bool((found.focal1 / scene.K1[:, 0, 0] - 1).abs().max() < 1e-6)
        True
    """
    check_tensor("F_mat", F_mat, ["B", "3", "3"])
    for name, points in (("principal1", principal1), ("principal2", principal2)):
        check_tensor(name, points, ["B", "2"])
        if len(points) != len(F_mat):
            raise ValueError(f"one of {name} per matrix is needed, got {len(points)} and {len(F_mat)} matrices")
    F = F_mat.to(solve_dtype(F_mat.device))
    eye = torch.eye(2).to(F).expand(len(F), 2, 2)
    T1, T2 = (affine_transform(eye, -points.to(F)) for points in (principal1, principal2))
    F = unit_matrix(transform_fundamental(F, T1, T2))
    products = [_products(M) for M in (F, F.mT)]
    with torch.no_grad():
        squares = torch.stack([-a * b / c for a, b, c in products])
        real = ((squares > 0) & squares.isfinite()).all(0)
        focal1, focal2 = torch.where(real, squares, 1.0).sqrt()
        scale1, scale2 = (torch.stack([f, f, torch.ones_like(f)], -1) for f in (focal1, focal2))
        a, b, _ = _products(unit_matrix(scale2[:, :, None] * F * scale1[:, None]))  # the third is their product
        determined = real & (1 / a.abs() + 1 / b.abs() + 1 / (a * b).abs() < 2 * MAX_SENSITIVITY)
    known = [torch.where(determined, -a * b / torch.where(determined, c, 1.0), 1.0) for a, b, c in products]
    focal1, focal2 = torch.where(determined, torch.stack(known).sqrt(), torch.nan).to(F_mat.dtype)
    return FocalLengths(focal1, focal2, determined)


def _products(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return Bougnoux's three products of matrices (B, 3, 3) with principal points at zero, (B,) each.

    The square of the first focal length is minus that of the first two over the third.
    """
    epipole, _ = smallest_right_singular_vector(F.mT)
    row = epipole[:, 0, None] * F[:, 1] - epipole[:, 1, None] * F[:, 0]
    return row[:, 2], F[:, 2, 2], (row[:, :2] * F[:, 2, :2]).sum(-1)
