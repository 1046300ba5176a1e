r"""The linear solver for the fundamental matrix.

A pair of point sets goes from pixels to a fundamental matrix in :func:`find_fundamental`, top to bottom, by the steps
in :mod:`~kornia_learnnorm.geometry.linear`, in float64 where the device has it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.geometry.checks import check_correspondences, is_true, solve_dtype
from kornia_learnnorm.geometry.linear import design_matrix, null_vector, rank2_projection
from kornia_learnnorm.geometry.rank2 import optimal_rank2
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.normalizers.closed_form import Hartley

__all__ = ["check_rank2", "find_fundamental", "normalizing_transforms"]

Normalizer = Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, Tensor]]


def find_fundamental(
    points1: Tensor,
    points2: Tensor,
    weights: Tensor | None = None,
    normalizer: Normalizer | None = None,
    rank2: Literal["optimal"] | None = None,
) -> Tensor:
    r"""Compute the fundamental matrix from eight or more correspondences by the normalised eight-point algorithm.

    The points are mapped to normalised coordinates :math:`\hat x_i = T_i x_i`, the direct linear transformation (DLT)
    finds :math:`\hat F` with :math:`\hat x_2^\top \hat F \hat x_1 = 0`, the rank-2 constraint is enforced **there**,
    and :math:`F = T_2^\top \hat F T_1`. With eight points the DLT is exact, and the normalisation acts only through the
    metric in which :math:`F` is projected. With ``rank2="optimal"``, :math:`T_2^\top \hat F T_1` is corrected in pixels
    by :func:`~kornia_learnnorm.geometry.rank2.optimal_rank2` instead; the result of eight points then depends on no
    normalisation.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        weights: optional non-negative weights :math:`(B, N)` of the squared algebraic residuals; zero means absent.
        normalizer: maps ``(points1, points2, weights)`` to the transforms :math:`(B, 3, 3)` of both views;
            :class:`~kornia_learnnorm.Hartley` when not given.
        rank2: how the singularity constraint is enforced: ``None`` projects in Frobenius norm in normalised
            coordinates, ``"optimal"`` corrects with the covariance of :math:`F`.

    Returns:
        fundamental matrices with shape :math:`(B, 3, 3)` in the dtype of the points, of rank 2 and unit Frobenius norm,
        :math:`x_2^\top F x_1 = 0`. The sign is arbitrary. Where the correspondences do not determine
        :math:`F` (coincident, collinear or coplanar points) it is one of the solutions and its null vector carries no
        gradient towards the others.

    Raises:
        TypeError: if the points are not floating-point tensors of one dtype, or the normaliser cannot be called.
        ShapeError: if the shapes do not agree with the above.
        ValueError: if there are fewer than eight correspondences, the views do not pair up, a value is not finite, a
            weight is negative, the normaliser does not return two finite transforms :math:`(B, 3, 3)`, or ``rank2``
            is neither ``None`` nor ``"optimal"``.

    Reference:
        R. Hartley, In defense of the eight-point algorithm, TPAMI 1997; B. Fan, Y. Dai, Y. Seo, M. He, A revisit of the
        normalized eight-point algorithm and a self-supervised deep solution, section 3.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> points1, points2 = torch.rand(4, 8, 2) * 600, torch.rand(4, 8, 2) * 600
        >>> find_fundamental(points1, points2).shape
        torch.Size([4, 3, 3])

    """
    check_correspondences(points1, points2, weights)
    check_rank2(rank2)
    dtype = solve_dtype(points1.device)
    x1, x2 = points1.to(dtype), points2.to(dtype)
    w = None if weights is None else weights.to(dtype)
    T1, T2 = (T.to(dtype) for T in normalizing_transforms(normalizer or Hartley(), x1, x2, w))
    A = design_matrix(convert_points_to_homogeneous(x1) @ T1.mT, convert_points_to_homogeneous(x2) @ T2.mT)
    F = torch.unflatten(null_vector(A, w), -1, (3, 3))
    if rank2 == "optimal":
        return optimal_rank2(transform_fundamental(F, T1, T2), x1, x2, w).to(points1.dtype)
    F = transform_fundamental(rank2_projection(F), T1, T2)
    F_mat: Tensor = F / torch.linalg.matrix_norm(F, keepdim=True)
    return F_mat.to(points1.dtype)


def check_rank2(rank2: str | None) -> None:
    """Raise a clear error for anything but a way to enforce the singularity constraint.

    Raises:
        ValueError: if ``rank2`` is neither ``None`` nor ``"optimal"``.

    """
    if rank2 not in (None, "optimal"):
        raise ValueError(f"rank2 must be None or 'optimal', got {rank2!r}")


def normalizing_transforms(normalizer: Normalizer, x1: Tensor, x2: Tensor, w: Tensor | None) -> tuple[Tensor, Tensor]:
    """Call a normaliser, which may be the user's own, and check what it returns.

    Raises:
        TypeError: if it cannot be called.
        ValueError: if it does not return two finite transforms :math:`(B, 3, 3)`.

    """
    if isinstance(normalizer, type) or not callable(normalizer):
        raise TypeError(f"normalizer must be a module or function, got {normalizer!r}")
    result = normalizer(x1, x2, w)
    expected = (x1.shape[0], 3, 3)
    shapes = [tuple(getattr(T, "shape", ())) for T in result] if isinstance(result, tuple | list) else [type(result)]
    if shapes != [expected, expected]:
        raise ValueError(f"a normalizer must return two transforms of shape {expected}, got {shapes}")
    T1, T2 = result
    if is_true(~(T1.isfinite().all() & T2.isfinite().all())):
        raise ValueError(f"the transforms of {type(normalizer).__name__} are not finite")
    return T1, T2
