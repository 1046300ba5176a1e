r"""Non-linear refinement of fundamental and essential matrices on distances in pixels, by Levenberg-Marquardt."""

from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kornia_learnnorm.estimators.optimize import RobustCost, attach_gradient, minimize
from kornia_learnnorm.estimators.robust_losses import Loss, check_loss, squared_loss
from kornia_learnnorm.geometry.checks import check_cameras, check_correspondences, check_matrices, solve_dtype
from kornia_learnnorm.geometry.distances import Distance
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.problem import hartley_coordinates
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.models.essential import Essential
from kornia_learnnorm.models.fundamental import Fundamental


class Refinement(NamedTuple):
    """Refined fundamental matrices, with costs and convergence."""

    F_mat: Tensor  # of rank 2 and unit Frobenius norm, (B, 3, 3)
    cost_before: Tensor  # weighted sum of the losses in square pixels at the given matrices, projected to rank 2, (B,)
    cost: Tensor  # weighted sum of the losses at `F_mat`, never larger, (B,)
    iterations: Tensor  # steps tried, (B,) int64
    converged: Tensor  # whether the gradient vanishes, up to `tolerance` of what its terms could sum to, (B,) bool


class EssentialRefinement(NamedTuple):
    """Refined essential matrices, and :class:`Refinement`'s fields of the fundamental matrices of the same poses."""

    E_mat: Tensor  # of unit Frobenius norm, singular values (s, s, 0), (B, 3, 3)
    F_mat: Tensor
    cost_before: Tensor
    cost: Tensor
    iterations: Tensor
    converged: Tensor


def refine_fundamental(
    points1: Tensor,
    points2: Tensor,
    F_mat: Tensor,
    weights: Tensor | None = None,
    distance: Distance = "sampson",
    loss: Loss = squared_loss,
    max_iterations: int = 50,
    tolerance: float = 1e-7,
) -> Refinement:
    r"""Refine fundamental matrices to a local minimum of a robust cost of the correspondences, by Levenberg-Marquardt.

    .. math:: \min_{\mathrm{rank} F = 2} \sum_i w_i\, \rho(d_i^2), \quad d_i = x_{2,i}^\top F x_{1,i} \,
              g\big(\|(F^\top x_{2,i})_{1:2}\|^2, \|(F x_{1,i})_{1:2}\|^2\big)

    Each element of the batch has its own damping. A step is accepted only if it lowers the cost, so the result is never
    worse than the given :math:`F`.

    The result is differentiable, once, in points and weights: by the implicit function theorem,
    :math:`\mathrm dp = -H^{-1} \mathrm d(\nabla_p\, \mathrm{cost})` with the exact Hessian :math:`H`. ``F_mat`` gets
    no gradient. Elements that did not converge or whose :math:`H` is not positive definite carry no gradient.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64; with shape
            :math:`(1, N, 2)`, all matrices share them.
        points2: pixels in the second image with the same shape.
        F_mat: initial matrices with shape :math:`(B, 3, 3)`, any scale but zero; those of rank 3 are first projected
            in Hartley's coordinates.
        weights: optional non-negative weights of the losses, :math:`(B, N)` or :math:`(1, N)` as the points; zero means
            absent.
        distance: the distance :math:`d`: ``"sampson"``, or ``"symmetric"`` (Fan et al., Eq. 8).
        loss: :math:`\rho` of squared distances: :func:`~kornia_learnnorm.estimators.robust_losses.squared_loss`,
            :class:`~kornia_learnnorm.Huber`, :class:`~kornia_learnnorm.Cauchy`,
            :class:`~kornia_learnnorm.GemanMcClure` or :class:`~kornia_learnnorm.Truncated`.
        max_iterations: largest number of steps tried. With outliers, robust losses sometimes need more than 50; such a
            result carries no gradient.
        tolerance: largest cosine between the distances and their derivatives at which a matrix has converged. 1e-3
            saves at least half of the steps and leaves the cost within about 0.2 % of the optimum: enough for an
            estimate, not for its gradient.

    Returns:
        the matrices with their costs, in the dtype of the points; costs carry no gradient.

    Raises:
        TypeError: if an argument is not a floating-point tensor, the points are not of one dtype, ``loss`` cannot be
            called or ``max_iterations`` is not a whole number.
        ShapeError: if a shape is wrong.
        ValueError: if there are fewer than eight correspondences, shapes do not pair up, a value is not finite, a
            matrix is zero, ``distance`` is unknown, or ``max_iterations`` or ``tolerance`` is negative.

    Reference:
        A. Bartoli, P. Sturm, Nonlinear estimation of the fundamental matrix with minimal parameters, TPAMI 2004; R.
        Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, section 11.4.3 and appendix 6.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> points1, points2 = torch.rand(4, 20, 2) * 600, torch.rand(4, 20, 2) * 600
        >>> refinement = refine_fundamental(points1, points2, torch.rand(4, 3, 3))
        >>> bool((refinement.cost < refinement.cost_before).all())
        True
    """
    cost, T1, T2 = _cost(distance, points1, points2, weights, loss, Fundamental.min_points)
    _check("F_mat", F_mat, points1, max_iterations, tolerance)
    with torch.no_grad():
        # The optimum does not depend on the coordinates in which it is sought.
        F = transform_fundamental(F_mat.to(T1), torch.linalg.inv_ex(T1)[0], torch.linalg.inv_ex(T2)[0])
        before, best = minimize(cost, Fundamental().state(F), max_iterations, tolerance)
    state = best.state
    if torch.is_grad_enabled() and (cost.x1.requires_grad or cost.x2.requires_grad or cost.weights.requires_grad):
        state = attach_gradient(cost, best)
    F = unit_matrix(transform_fundamental(state.matrix(), T1, T2))
    F, before, last = (x.to(points1.dtype) for x in (F, before, best.cost))
    return Refinement(F, before, last, best.iterations, best.converged)


@torch.no_grad()
def refine_essential(
    points1: Tensor,
    points2: Tensor,
    E_mat: Tensor,
    K1: Tensor,
    K2: Tensor,
    weights: Tensor | None = None,
    loss: Loss = squared_loss,
    distance: Distance = "sampson",
    max_iterations: int = 50,
    tolerance: float = 1e-7,
) -> EssentialRefinement:
    r"""Refine essential matrices to a local minimum of a robust cost of the correspondences, by Levenberg-Marquardt.

    .. math:: \min_{E = U \mathrm{diag}(1, 1, 0) V^\top / \sqrt 2} \sum_i w_i\, \rho(d_i^2), \quad
              d_i \text{ the distance in pixels under } F = K_2^{-\top} E K_1^{-1}

    over rotations :math:`U` and :math:`V`, which give :math:`E` the five degrees of freedom of a relative pose. The
    steps are those of :func:`~kornia_learnnorm.refine_fundamental`, in float64. The result carries no gradients: use
    :func:`~kornia_learnnorm.refine_fundamental` if you need them or the cameras are unknown.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)` or :math:`(1, N, 2)`, :math:`N \ge 5`.
        points2: pixels in the second image with the same shape.
        E_mat: initial matrices with shape :math:`(B, 3, 3)`, any scale but zero; made essential first.
        K1: cameras of the first images with shape :math:`(3, 3)` or :math:`(B, 3, 3)`.
        K2: cameras of the second images with shape :math:`(3, 3)` or :math:`(B, 3, 3)`.
        weights: see :func:`~kornia_learnnorm.refine_fundamental` for this argument and the following ones.
        loss: :math:`\rho` of squared distances.
        distance: the distance :math:`d`: ``"sampson"`` or ``"symmetric"``.
        max_iterations: largest number of steps tried.
        tolerance: largest cosine at which a matrix has converged.

    Returns:
        the matrices with their costs, in the dtype of the points.

    Raises:
        TypeError, ShapeError, ValueError: as :func:`~kornia_learnnorm.refine_fundamental`, but five points
            are enough; a ValueError too if a camera is not invertible.

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
    cost, T1, T2 = _cost(distance, points1, points2, weights, loss, Essential.sample_size)
    _check("E_mat", E_mat, points1, max_iterations, tolerance)
    check_cameras(K1, K2, len(E_mat))
    state = Essential.of_cameras(K1.to(T1), K2.to(T2), T1, T2).calibrated(E_mat.to(T1))
    before, best = minimize(cost, state, max_iterations, tolerance)
    E, F = best.state.essential(), transform_fundamental(best.state.matrix(), T1, T2)
    E, F, before, last = (x.to(points1.dtype) for x in (unit_matrix(E), unit_matrix(F), before, best.cost))
    return EssentialRefinement(E, F, before, last, best.iterations, best.converged)


def _check(name: str, matrices: Tensor, points1: Tensor, max_iterations: int, tolerance: float) -> None:
    shared = len(points1) == 1 and isinstance(matrices, Tensor)
    check_matrices(name, matrices, len(matrices) if shared else len(points1))
    if not isinstance(max_iterations, int):
        raise TypeError(f"max_iterations must be a whole number, got {max_iterations!r}")
    if max_iterations < 0 or not tolerance >= 0:
        raise ValueError(f"max_iterations and tolerance must be >= 0, got {max_iterations} and {tolerance}")


def _cost(
    distance: Distance, points1: Tensor, points2: Tensor, weights: Tensor | None, loss: Loss, min_points: int
) -> tuple[RobustCost, Tensor, Tensor]:
    """Return the cost of correspondences, and the transforms from pixels to its coordinates, without gradient."""
    check_correspondences(points1, points2, weights, min_points)
    check_loss(loss)
    dtype = solve_dtype(points1.device)
    x1, x2 = points1.to(dtype), points2.to(dtype)
    weights = torch.ones_like(x1[..., 0]) if weights is None else weights.to(dtype)
    with torch.no_grad():
        # Pixels relative to the centroid, and a third coordinate of their size: distances stay in pixels.
        T1, T2 = (T / T[:, :1, :1] for T in (hartley_coordinates(x, weights)[1] for x in (x1, x2)))
    x1, x2 = (T @ convert_points_to_homogeneous(x).mT for T, x in ((T1, x1), (T2, x2)))
    return RobustCost(Fundamental(distance=distance), x1, x2, weights, loss), T1, T2
