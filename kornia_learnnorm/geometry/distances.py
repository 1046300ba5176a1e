r"""Residuals of correspondences under a fundamental matrix, one number per correspondence.

All take pixels ``points1, points2`` :math:`(*, N, 2)` and ``F_mat`` :math:`(*, 3, 3)` with :math:`x_2^\top F x_1 = 0`.
"""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import (
    left_to_right_epipolar_distance,
    right_to_left_epipolar_distance,
    sampson_epipolar_distance,
)
from torch import Tensor

__all__ = ["algebraic_distance", "sampson_distance", "symmetric_epipolar_distance"]


def _check(points1: Tensor, points2: Tensor, F_mat: Tensor) -> None:
    for name, value in (("points1", points1), ("points2", points2), ("F_mat", F_mat)):
        if not isinstance(value, Tensor) or not value.is_floating_point():
            raise TypeError(f"{name} must be a floating-point tensor, got {getattr(value, 'dtype', type(value))}")
    KORNIA_CHECK_SHAPE(points1, ["*", "N", "2"])
    KORNIA_CHECK_SHAPE(points2, ["*", "N", "2"])
    KORNIA_CHECK_SHAPE(F_mat, ["*", "3", "3"])
    if not points1.dtype == points2.dtype == F_mat.dtype:
        raise TypeError(f"one dtype is needed, got {points1.dtype}, {points2.dtype} and {F_mat.dtype}")
    if points1.shape[-2] != points2.shape[-2]:
        raise ValueError(f"points1 and points2 must pair up, got shapes {[*points1.shape]} and {[*points2.shape]}")


def symmetric_epipolar_distance(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    r"""Return the sum of the distances of both points to their epipolar lines (Fan et al., Eq. 7).

    :math:`|x_2^\top F x_1| \left( 1 / \|(F^\top x_2)_{1:2}\| + 1 / \|(F x_1)_{1:2}\| \right)`. It is not
    ``kornia.geometry.epipolar.symmetrical_epipolar_distance``, which adds the squares.

    Args:
        points1: pixels in the first image with shape :math:`(*, N, 2)`.
        points2: pixels in the second image with shape :math:`(*, N, 2)`.
        F_mat: fundamental matrices with shape :math:`(*, 3, 3)`, any scale.

    Returns:
        distances in pixels with shape :math:`(*, N)`; infinite for a point on an epipole.

    Raises:
        TypeError: if an argument is not a floating-point tensor, or their dtypes differ.
        ShapeError: if a shape is wrong.
        ValueError: if the points do not pair up.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])  # lines are rows
        >>> symmetric_epipolar_distance(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 3.0]]]), F_mat)
        tensor([[4.]])

    """
    _check(points1, points2, F_mat)
    right = left_to_right_epipolar_distance(points1, points2, F_mat)
    return right + right_to_left_epipolar_distance(points1, points2, F_mat)


def sampson_distance(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    r"""Return the Sampson distance, the first-order distance to the nearest exact correspondence.

    :math:`|x_2^\top F x_1| / \sqrt{\|(F x_1)_{1:2}\|^2 + \|(F^\top x_2)_{1:2}\|^2}` (Hartley and Zisserman, section
    11.4.3; not squared).

    Args:
        points1: pixels in the first image with shape :math:`(*, N, 2)`.
        points2: pixels in the second image with shape :math:`(*, N, 2)`.
        F_mat: fundamental matrices with shape :math:`(*, 3, 3)`, any scale.

    Returns:
        distances in pixels with shape :math:`(*, N)`.

    Raises:
        TypeError: if an argument is not a floating-point tensor, or their dtypes differ.
        ShapeError: if a shape is wrong.
        ValueError: if the points do not pair up.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
        >>> sampson_distance(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 3.0]]]), F_mat)
        tensor([[1.4142]])

    """
    _check(points1, points2, F_mat)
    return sampson_epipolar_distance(points1, points2, F_mat, squared=False)


def algebraic_distance(points1: Tensor, points2: Tensor, F_mat: Tensor) -> Tensor:
    r"""Return :math:`|x_2^\top F x_1|` with :math:`F` scaled to unit Frobenius norm.

    Args:
        points1: pixels in the first image with shape :math:`(*, N, 2)`.
        points2: pixels in the second image with shape :math:`(*, N, 2)`.
        F_mat: fundamental matrices with shape :math:`(*, 3, 3)`, any scale but zero.

    Returns:
        algebraic residuals with shape :math:`(*, N)`; their unit depends on the coordinates of the points.

    Raises:
        TypeError: if an argument is not a floating-point tensor, or their dtypes differ.
        ShapeError: if a shape is wrong.
        ValueError: if the points do not pair up.

    Example:
        >>> F_mat = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
        >>> algebraic_distance(torch.tensor([[[5.0, 1.0]]]), torch.tensor([[[9.0, 3.0]]]), F_mat)
        tensor([[1.4142]])

    """
    _check(points1, points2, F_mat)
    F_mat = F_mat / F_mat.norm(dim=(-2, -1), keepdim=True)
    x1, x2 = convert_points_to_homogeneous(points1), convert_points_to_homogeneous(points2)
    return torch.einsum("...ni,...ij,...nj->...n", x2, F_mat, x1).abs()
