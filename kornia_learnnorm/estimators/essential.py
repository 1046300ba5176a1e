r"""Non-linear refinement of essential matrices: Levenberg-Marquardt on distances in pixels, with known cameras.

Matrices move on the manifold of :mod:`~kornia_learnnorm.geometry.manifold`, whose steps have five parameters. The cost
is that of :mod:`~kornia_learnnorm.estimators.refinement`, of :math:`F = K_2^{-\top} E K_1^{-1}`.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.estimators.epipolar_cost import EpipolarCost
from kornia_learnnorm.estimators.refinement import check_options, minimize
from kornia_learnnorm.estimators.robust_losses import Loss, squared_loss
from kornia_learnnorm.geometry.checks import check_cameras, check_correspondences, check_tensor, is_true, solve_dtype
from kornia_learnnorm.geometry.distances import DistanceScale, find_scale
from kornia_learnnorm.geometry.manifold import Calibrated, decompose_essential
from kornia_learnnorm.geometry.transforms import hartley_transform, transform_fundamental, unit_fundamental

__all__ = ["EssentialRefinement", "calibrated_state", "refine_essential"]

MIN_POINTS = 5  # correspondences that determine an essential matrix, up to ten solutions


class EssentialRefinement(NamedTuple):
    """Refined essential matrices and how they were reached.

    Attributes:
        E_mat: essential matrices of unit Frobenius norm, singular values (s, s, 0), (B, 3, 3).
        F_mat: fundamental matrices of unit Frobenius norm of the same poses, for pixels, (B, 3, 3).
        cost_before: weighted sum of the losses in square pixels at the nearest essential matrices to those given, (B,).
        cost: weighted sum of the losses at ``E_mat``, never larger, (B,).
        iterations: steps tried, (B,) int64.
        converged: whether the gradient vanishes, up to ``tolerance`` of what its terms could sum to, (B,) bool.
    """

    E_mat: Tensor
    F_mat: Tensor
    cost_before: Tensor
    cost: Tensor
    iterations: Tensor
    converged: Tensor


@torch.no_grad()
def refine_essential(
    points1: Tensor,
    points2: Tensor,
    E_mat: Tensor,
    K1: Tensor,
    K2: Tensor,
    weights: Tensor | None = None,
    loss: Loss = squared_loss,
    distance: Literal["sampson", "symmetric"] | DistanceScale = "sampson",
    max_iterations: int = 50,
    tolerance: float = 1e-7,
) -> EssentialRefinement:
    r"""Refine essential matrices to a local minimum of a sum over the correspondences, by Levenberg-Marquardt.

    .. math:: \min_{E = U \mathrm{diag}(1, 1, 0) V^\top / \sqrt 2} \sum_i w_i\, \rho(d_i^2), \quad
              d_i \text{ the distance in pixels under } F = K_2^{-\top} E K_1^{-1}

    over rotations :math:`U` and :math:`V`, which have five parameters in :math:`E`: those of a relative pose. Each
    element of the batch has its own damping; a step is taken where it lowers the cost and refused where it does not or
    cannot be computed. The steps are computed in float64. There are no gradients: the result carries none. Use
    :func:`~kornia_learnnorm.refine_fundamental` where gradients are needed or the cameras are not known.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 5`, float32 or float64; with shape
            :math:`(1, N, 2)`, all matrices share them.
        points2: pixels in the second image with the same shape.
        E_mat: where to start, with shape :math:`(B, 3, 3)`, any scale but zero; the nearest essential matrix is taken.
        K1: cameras of the first images with shape :math:`(3, 3)` or :math:`(B, 3, 3)`.
        K2: cameras of the second images with shape :math:`(3, 3)` or :math:`(B, 3, 3)`.
        weights: optional non-negative weights of the losses, :math:`(B, N)` or :math:`(1, N)` as the points; zero means
            absent.
        loss: :math:`\rho` of squared distances, as for :func:`~kornia_learnnorm.refine_fundamental`.
        distance: the distance :math:`d`: ``"sampson"``, ``"symmetric"`` (Fan et al., Eq. 7), or a function such as
            :func:`~kornia_learnnorm.sampson_scale`.
        max_iterations: largest number of steps tried.
        tolerance: largest cosine between the distances and their derivatives at which a matrix has converged.

    Returns:
        the matrices with their costs, in the dtype of the points.

    Raises:
        TypeError: if an argument is not a floating-point tensor, the points are not of one dtype, ``loss`` cannot be
            called or ``max_iterations`` is not a whole number.
        ShapeError: if a shape is wrong.
        ValueError: if there are fewer than five correspondences, shapes do not pair up, a value is not finite, a matrix
            is zero, a camera is not invertible, there is no distance of that name, or ``max_iterations`` or
            ``tolerance`` is negative.

    Reference:
        R. Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, sections 9.6 and 11.4.3; V. Larsson, PoseLib,
        which refines a rotation and a direction of translation on the same cost.

    Example:
        >>> from kornia_learnnorm.data.synthetic import handheld
        >>> scene = handheld(4, 20, torch.Generator().manual_seed(0), noise=0.5)
        >>> E_mat = scene.K2.mT @ scene.F_mat @ scene.K1
        >>> refinement = refine_essential(scene.points1, scene.points2, E_mat, scene.K1, scene.K2)
        >>> bool((refinement.cost < refinement.cost_before).all())
        True

    """
    check_correspondences(points1, points2, weights, MIN_POINTS)
    _check_essential(E_mat, len(E_mat) if len(points1) == 1 and isinstance(E_mat, Tensor) else len(points1))
    check_cameras(K1, K2, len(E_mat))
    check_options(loss, max_iterations, tolerance)
    dtype = solve_dtype(points1.device)
    x1, x2 = points1.to(dtype), points2.to(dtype)
    w = torch.ones_like(x1[..., 0]) if weights is None else weights.to(dtype)
    # Pixels from the centroid, and a third coordinate as large as they are: distances are those in pixels.
    T1, T2 = (T / T[:, :1, :1] for T in (hartley_transform(x1, w), hartley_transform(x2, w)))
    x1, x2 = T1 @ convert_points_to_homogeneous(x1).mT, T2 @ convert_points_to_homogeneous(x2).mT
    objective = EpipolarCost(x1, x2, w, find_scale(distance), loss)
    state = calibrated_state(E_mat.to(dtype), T1, T2, K1.to(x1), K2.to(x1))
    before, best = minimize(objective, state, max_iterations, tolerance)
    E, F = best.state.essential(), transform_fundamental(best.state.matrix(), T1, T2)
    values = (unit_fundamental(E), unit_fundamental(F), before, best.cost)
    E, F, before, cost = (value.to(points1.dtype) for value in values)
    return EssentialRefinement(E, F, before, cost, best.iterations, best.converged)


def calibrated_state(E_mat: Tensor, T1: Tensor, T2: Tensor, K1: Tensor, K2: Tensor) -> Calibrated:
    """Return the nearest essential matrices as points on the manifold of fundamental matrices of transformed pixels.

    Args:
        E_mat: matrices with shape :math:`(B, 3, 3)`, any scale but zero.
        T1: transforms of the pixels of view 1, with a shape that broadcasts to :math:`(B, 3, 3)`.
        T2: transforms of the pixels of view 2.
        K1: cameras of view 1.
        K2: cameras of view 2.

    """
    C1, C2 = (torch.linalg.inv_ex(T @ K)[0] for T, K in ((T1, K1), (T2, K2)))
    # Of unit norm, so that the fundamental matrices have a norm of about one too.
    C1, C2 = (C / torch.linalg.matrix_norm(C, keepdim=True) for C in (C1, C2))
    return decompose_essential(E_mat, C1.expand_as(E_mat), C2.expand_as(E_mat))


def _check_essential(E_mat: Tensor, number: int) -> None:
    check_tensor("E_mat", E_mat, ["B", "3", "3"])
    if len(E_mat) != number:
        raise ValueError(f"one matrix per set of points is needed, got {len(E_mat)} matrices and {number} sets")
    if is_true(~E_mat.isfinite().all()):
        raise ValueError(f"E_mat must be finite, got {int((~E_mat.isfinite()).sum())} NaN or infinite values")
    if is_true((zero := (E_mat == 0).all(-1).all(-1)).any()):
        raise ValueError(f"E_mat must not be zero, got {int(zero.sum())} zero matrices")
