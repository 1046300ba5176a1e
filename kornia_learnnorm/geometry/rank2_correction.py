r"""The rank-2 (singularity) constraint: projection in Frobenius norm, and optimal correction.

The projection moves every entry of :math:`F` as if all were equally certain. But the correspondences determine some
combinations of entries well and others hardly at all. The optimal correction moves :math:`F` along the uncertain ones,
weighted by its covariance, so its metric does not depend on a normalisation.
"""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import check_correspondences, check_matrices, safe_divisor
from kornia_learnnorm.geometry.distances import line_norms
from kornia_learnnorm.geometry.dlt import design_matrix
from kornia_learnnorm.geometry.matrices import cofactors, inverse, nearest_rank2, unit_matrix
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import transform_fundamental

ITERATIONS = 3  # steps of the optimal correction
EPIPOLE_FLOOR = 1e-5  # of the mean norm of a line's normal, added to each in the covariance


def optimal_rank2(F_mat: Tensor, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> Tensor:
    r"""Correct matrices to rank 2 along the directions that the correspondences leave uncertain.

    With :math:`u = \mathrm{vec}(F)`, :math:`\|u\| = 1`, :math:`\xi_i = x_{2,i} \otimes x_{1,i}` and :math:`V_i` the
    covariance of :math:`\xi_i` under equal noise on all pixel coordinates, the covariance of :math:`u` is up to scale

    .. math:: V_0 = \Big( \sum_i w_i \frac{P_u \xi_i \xi_i^\top P_u}{(u, V_i u)} \Big)^{-}, \quad P_u = I - u u^\top .

    Each iteration takes the step of least Mahalanobis length that meets the linearised constraint, with
    :math:`u^\dagger` the cofactors of :math:`F`, that is the gradient of its determinant, :math:`(u, u^\dagger) = 3
    \det F`:

    .. math:: u \leftarrow N\Big[ u - \frac{(u, u^\dagger)}{3\, (u^\dagger, V_0 u^\dagger)} V_0 u^\dagger \Big], \quad
              V_0 \leftarrow P_u V_0 P_u .

    After three iterations, a projection in Hartley's coordinates removes the rest of the determinant.

    Args:
        F_mat: matrices in pixels with shape :math:`(B, 3, 3)`, any scale but zero, such as null vectors of the DLT.
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        weights: optional non-negative weights :math:`(B, N)`, inverse variances up to scale; zero means absent.

    Returns:
        fundamental matrices with shape :math:`(B, 3, 3)` in the dtype of the points, of rank 2 and unit Frobenius norm.
        Where the correspondences do not determine :math:`F`, the correction is along its free directions, and
        :math:`V_0` carries no gradient.

    Raises:
        TypeError: if an argument is not a floating-point tensor or the points are not of one dtype.
        ShapeError: if a shape is wrong.
        ValueError: if there are fewer than eight correspondences, shapes do not pair up, a value is not finite, a
            weight is negative, a matrix is zero.

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
    check_matrices("F_mat", F_mat, len(points1))
    problem = LinearProblem.from_points(points1, points2, weights, None)
    F_hat = transform_fundamental(F_mat.to(problem.x1), inverse(problem.T1), inverse(problem.T2))
    F_mat = transform_fundamental(correct_rank2(problem, F_hat), problem.T1, problem.T2)
    return unit_matrix(F_mat).to(points1.dtype)


def correct_rank2(problem: LinearProblem, M: Tensor) -> Tensor:
    """Return the optimal correction of matrices (B, 3, 3) in a problem's coordinates; see :func:`optimal_rank2`."""
    u = normalize(M.flatten(-2), dim=-1)
    covariance = _covariance(problem, u)
    visited: list[Tensor] = []
    for _ in range(ITERATIONS):
        visited.append(u)
        gradient = step = cofactors(torch.unflatten(u, -1, (3, 3))).flatten(-2)
        # Projecting the vectors costs less than projecting V_0.
        for direction in reversed(visited):
            step = _project(step, direction)
        step = (covariance @ step[..., None]).squeeze(-1)
        for direction in visited:
            step = _project(step, direction)
        slope = (gradient * step).sum(-1, keepdim=True)
        residual = (u * gradient).sum(-1, keepdim=True) / 3
        u = normalize(u - residual / torch.where(slope > 0, slope, 1.0) * step, dim=-1)
    return nearest_rank2(torch.unflatten(u, -1, (3, 3)))


def _covariance(problem: LinearProblem, u: Tensor) -> Tensor:
    """Return a matrix that equals ``V_0`` of the unit vectors ``u`` up to scale once projected, ``(B, 9, 9)``."""
    x1, x2, weights = problem.x1, problem.x2, problem.weights
    scale = (problem.T1[:, 0, 0] / problem.T2[:, 0, 0])[:, None]  # noise that is equal in pixels is not equal there
    # (u, V_i u) is the sum of the squared normals of both epipolar lines.
    n1, n2 = line_norms(x1.mT, x2.mT, torch.unflatten(u, -1, (3, 3)), weights, floor=EPIPOLE_FLOOR)
    variance = scale * n1.square() + n2.square() / scale
    A = design_matrix(x1, x2)
    A = torch.addcmul(A, A @ u[..., None], u[:, None], value=-1)
    precision = A.mT @ ((1.0 if weights is None else weights) / variance)[..., None].mul(A)
    size = safe_divisor(precision.diagonal(dim1=-2, dim2=-1).sum(-1))[:, None, None]
    # The pseudo-inverse is the inverse once u itself is given some precision. The ridge is above rounding and lets the
    # directions that no correspondence sees move freely.
    ridge = 64 * torch.finfo(u.dtype).eps
    precision = torch.addcmul(precision, size * u[..., None], u[:, None])
    precision = torch.addcmul(precision, size, ridge * torch.eye(9, dtype=u.dtype, device=u.device))
    covariance = torch.linalg.inv_ex(precision)[0]
    held = covariance.detach().diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * size > 1 / (64 * ridge)
    return torch.where(held, covariance.detach(), covariance)


def _project(vector: Tensor, u: Tensor) -> Tensor:
    """Return ``P_u x`` of vectors ``x``, ``(B, 9)``."""
    return torch.addcmul(vector, (vector * u).sum(-1, keepdim=True), u, value=-1)
