r"""The singularity constraint imposed where the correspondences allow it: a correction weighted by a covariance.

The nearest matrix of rank 2 in Frobenius norm moves every entry of :math:`F` as if all were equally certain. They are
not: the correspondences fix some combinations well and others hardly at all. This correction moves :math:`F` along the
uncertain ones, and so needs no normalisation to choose a metric for it.
"""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import check_correspondences, is_true, solve_dtype
from kornia_learnnorm.geometry.linear import design_matrix, rank2_projection
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.normalizers.closed_form import Hartley
from kornia_learnnorm.normalizers.reweighted import adjugate, line_norms

__all__ = ["check_fundamental", "optimal_rank2"]


def optimal_rank2(
    F_mat: Tensor, points1: Tensor, points2: Tensor, weights: Tensor | None = None, iterations: int = 3
) -> Tensor:
    r"""Correct matrices to rank 2 along the directions that the correspondences leave uncertain.

    With :math:`u = \mathrm{vec}(F)`, :math:`\|u\| = 1`, :math:`\xi_i = x_{2,i} \otimes x_{1,i}` and :math:`V_i` the
    covariance of :math:`\xi_i` under equal noise on all pixel coordinates, the covariance of :math:`u` is up to scale

    .. math:: V_0 = \Big( \sum_i w_i \frac{P_u \xi_i \xi_i^\top P_u}{(u, V_i u)} \Big)^{-}, \quad P_u = I - u u^\top .

    Each iteration takes the step of least Mahalanobis length that meets the linearised constraint, with
    :math:`u^\dagger` the cofactors of :math:`F`, that is the gradient of its determinant, :math:`(u, u^\dagger) = 3
    \det F`:

    .. math:: u \leftarrow N\Big[ u - \frac{(u, u^\dagger)}{3\, (u^\dagger, V_0 u^\dagger)} V_0 u^\dagger \Big], \quad
              V_0 \leftarrow P_u V_0 P_u .

    What is left of the determinant goes with a projection in Hartley's coordinates.

    Args:
        F_mat: matrices in pixels with shape :math:`(B, 3, 3)`, any scale but zero, such as null vectors of the DLT.
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        weights: optional non-negative weights :math:`(B, N)`, inverse variances up to scale; zero means absent.
        iterations: number of steps; 0 projects in Hartley's coordinates and nothing else.

    Returns:
        fundamental matrices with shape :math:`(B, 3, 3)` in the dtype of the points, of rank 2 and unit Frobenius norm.
        Where the correspondences do not determine :math:`F`, its free directions meet the constraint, and
        :math:`V_0` carries no gradient.

    Raises:
        TypeError: if an argument is not a floating-point tensor or the points are not of one dtype.
        ShapeError: if a shape is wrong.
        ValueError: if there are fewer than eight correspondences, shapes do not pair up, a value is not finite, a
            matrix is zero, or ``iterations`` is negative.

    Reference:
        K. Kanatani, Y. Sugaya, Fundamental matrix computation: theory and practice, Memoirs of the Faculty of
        Engineering, Okayama University 42, 2008, on a posteriori correction.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> points1, points2 = torch.rand(4, 8, 2) * 600, torch.rand(4, 8, 2) * 600
        >>> optimal_rank2(torch.rand(4, 3, 3), points1, points2).shape
        torch.Size([4, 3, 3])

    """
    check_correspondences(points1, points2, weights)
    check_fundamental(F_mat, points1)
    if iterations < 0:
        raise ValueError(f"iterations must be >= 0, got {iterations}")
    dtype = solve_dtype(points1.device)
    x1, x2 = points1.to(dtype), points2.to(dtype)
    w = None if weights is None else weights.to(dtype)
    T1, T2 = Hartley()(x1, x2, w)
    F = transform_fundamental(F_mat.to(dtype), torch.linalg.inv_ex(T1)[0], torch.linalg.inv_ex(T2)[0])
    u = normalize(F.flatten(-2), dim=-1)
    if iterations:
        x1 = convert_points_to_homogeneous(x1) @ T1.mT
        x2 = convert_points_to_homogeneous(x2) @ T2.mT
        u = _correct(u, _covariance(u, x1, x2, w, T1[:, 0, 0] / T2[:, 0, 0]), iterations)
    F = transform_fundamental(rank2_projection(torch.unflatten(u, -1, (3, 3))), T1, T2)
    F_rank2: Tensor = F / torch.linalg.matrix_norm(F, keepdim=True)
    return F_rank2.to(points1.dtype)


def check_fundamental(F_mat: Tensor, points: Tensor) -> None:
    """Raise a clear error for anything but finite matrices ``(B, 3, 3)`` other than zero, as many as sets of points.

    Raises:
        TypeError: if it is not a floating-point tensor.
        ShapeError: if it is not ``(B, 3, 3)``.
        ValueError: if the batch sizes differ, a value is not finite, or a matrix is zero.

    """
    if not isinstance(F_mat, Tensor) or not F_mat.is_floating_point():
        raise TypeError(f"F_mat must be a floating-point tensor, got {getattr(F_mat, 'dtype', type(F_mat))}")
    KORNIA_CHECK_SHAPE(F_mat, ["B", "3", "3"])
    if len(F_mat) != len(points):
        raise ValueError(f"one matrix per set of points is needed, got {len(F_mat)} matrices and {len(points)} sets")
    if is_true(~F_mat.isfinite().all()):
        raise ValueError(f"F_mat must be finite, got {int((~F_mat.isfinite()).sum())} NaN or infinite values")
    zero = (F_mat == 0).all(-1).all(-1)
    if is_true(zero.any()):
        raise ValueError(f"F_mat must not be zero, got {int(zero.sum())} zero matrices")


def _covariance(u: Tensor, x1: Tensor, x2: Tensor, weights: Tensor | None, scale: Tensor) -> Tensor:
    """``V_0`` of the unit vectors ``u`` up to scale, ``(B, 9, 9)``; ``scale`` is that of view 1 over that of view 2."""
    # (u, V_i u) is the sum of the squared normals of both epipolar lines; equal noise in pixels is not equal here.
    n1, n2 = line_norms(x1, x2, torch.unflatten(u, -1, (3, 3)), weights, floor=1e-5)
    variance = scale[:, None] * n1.square() + n2.square() / scale[:, None]
    A = design_matrix(x1, x2)
    A = A - (A @ u[..., None]) * u[..., None, :]
    precision = A.mT @ ((1.0 if weights is None else weights) / variance)[..., None].mul(A)
    size = precision.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    precision = precision / torch.where(size > 0, size, 1.0)
    # The pseudo-inverse is the inverse once u itself is given some precision. The ridge is above rounding and lets the
    # directions that no correspondence sees move freely.
    ridge = 64 * torch.finfo(u.dtype).eps
    eye = torch.eye(9, dtype=u.dtype, device=u.device)
    inverse = torch.linalg.inv_ex(precision + u[..., :, None] * u[..., None, :] + ridge * eye)[0]
    held = inverse.detach().diagonal(dim1=-2, dim2=-1).sum(-1) > 1 / (64 * ridge)
    return _project(torch.where(held[:, None, None], inverse.detach(), inverse), u)


def _correct(u: Tensor, covariance: Tensor, iterations: int) -> Tensor:
    for _ in range(iterations):
        cofactors = adjugate(torch.unflatten(u, -1, (3, 3))).mT.flatten(-2)
        step = (covariance @ cofactors[..., None]).squeeze(-1)
        slope = (cofactors * step).sum(-1, keepdim=True)
        residual = (u * cofactors).sum(-1, keepdim=True) / 3
        u = normalize(u - residual / torch.where(slope > 0, slope, 1.0) * step, dim=-1)
        covariance = _project(covariance, u)
    return u


def _project(covariance: Tensor, u: Tensor) -> Tensor:
    """``P_u V P_u``."""
    covariance = covariance - u[..., :, None] * (u[..., None, :] @ covariance)
    return covariance - (covariance @ u[..., None]) * u[..., None, :]
