r"""Whitening with weights taken from the epipolar geometry: the closed-form way to a good rank-2 projection.

Eight points have an exact null vector :math:`F_0`, whatever the normalisation. Projecting it to rank 2 in normalised
coordinates subtracts a matrix of rank one, :math:`F = F_0 - \sigma\, a b^\top`, so correspondence :math:`i` is left
with the residual :math:`\sigma\, (a^\top x_{2,i}) (b^\top x_{1,i})`. The normalisation chooses the lines :math:`a` and
:math:`b`, and nothing else. Given :math:`a`, the best :math:`b` is a weighted least-squares problem with the normal
matrix :math:`S_1 = \sum_i \omega_i x_{1,i} x_{1,i}^\top`, and the same for :math:`a`; the two hold together where
:math:`a` and :math:`b` are singular vectors of :math:`F_0` in the coordinates whitened by :math:`S_1` and :math:`S_2`.
So alternating least squares is iterated whitening.
"""

from __future__ import annotations

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor, nn
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import solve_dtype, weighted_mean
from kornia_learnnorm.geometry.linear import design_matrix, has_null_vector, null_vector, smallest_right_singular_vector
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.normalizers.closed_form import Hartley, Whitening

__all__ = ["ReweightedWhitening", "adjugate", "line_norms"]


class ReweightedWhitening(nn.Module):
    r"""Whitening with weights that make the rank-2 projection minimise the symmetric epipolar distance.

    Starts from the DLT's null vector :math:`F_0` and the weights
    :math:`w_i = 1 / \|(F_0^\top x_{2,i})_{1:2}\| + 1 / \|(F_0 x_{1,i})_{1:2}\|`, the factor from an algebraic residual
    to the symmetric epipolar distance (Fan et al., Eq. 7). Each iteration finds the lines :math:`a, b` of the rank-2
    correction, :math:`b \propto S_1^{-1} F_0^{-1} a` and :math:`a \propto S_2^{-1} F_0^{-\top} b`, and sets the weights
    of view 1 to :math:`w_i |a^\top x_{2,i}| / |b^\top x_{1,i}|`, of view 2 to its mirror image: iteratively reweighted
    least squares for the sum of absolute residuals. The views take turns together, not one after the other, so that
    swapping them swaps the transforms.

    Args:
        iterations: number of reweightings; 0 whitens with :math:`w`.
        damping: share of the mean residual added to each residual before it divides.

    Raises:
        ValueError: if ``iterations`` is negative or ``damping`` is not positive.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> T1, T2 = ReweightedWhitening()(torch.rand(2, 8, 2), torch.rand(2, 8, 2))
        >>> T1.shape
        torch.Size([2, 3, 3])

    """

    def __init__(self, iterations: int = 10, damping: float = 0.1) -> None:
        super().__init__()
        if iterations < 0 or damping <= 0:
            raise ValueError(f"iterations must be >= 0 and damping > 0, got {iterations} and {damping}")
        self.iterations = iterations
        self.damping = damping
        self.hartley, self.whitening = Hartley(), Whitening()

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        dtype = solve_dtype(points1.device)
        weights = None if weights is None else weights.to(dtype)
        H1, H2 = self.hartley(points1.to(dtype), points2.to(dtype), weights)
        # Hartley's coordinates keep the shape of the pixels, which the distances to lines need.
        x1 = convert_points_to_homogeneous(points1.to(dtype)) @ H1.mT
        x2 = convert_points_to_homogeneous(points2.to(dtype)) @ H2.mT
        w1, w2 = self._weigh(*_hold_undetermined(x1, x2, weights))
        T1, T2 = self._whiten(x1, x2, w1, w2)
        return (T1 @ H1).to(points1.dtype), (T2 @ H2).to(points2.dtype)

    def _whiten(self, x1: Tensor, x2: Tensor, w1: Tensor, w2: Tensor) -> tuple[Tensor, Tensor]:
        return self.whitening(x1[..., :2], x2[..., :2], w1)[0], self.whitening(x1[..., :2], x2[..., :2], w2)[1]

    def _weigh(self, x1: Tensor, x2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the weights of the last whitening, of both views, ``(B, N)``."""
        F0 = torch.unflatten(null_vector(design_matrix(x1, x2), weights), -1, (3, 3))
        given: Tensor | float = 1.0 if weights is None else weights
        w1 = w2 = given * _distance_factor(x1, x2, F0, weights)
        if self.iterations == 0:
            return w1, w2
        # Adjugates stand for inverses: a line has no scale, and they exist where inverses do not.
        inverse = adjugate(F0)
        b = self._first_line(x1, x2, F0, w1, w2)
        a = _solve(x2, w2, inverse.mT, b)
        for iteration in range(self.iterations):
            if iteration:
                b, a = _solve(x1, w1, inverse, a), _solve(x2, w2, inverse.mT, b)
            r1, r2 = (x1 @ b[..., None]).squeeze(-1).abs(), (x2 @ a[..., None]).squeeze(-1).abs()
            w = _distance_factor(x1, x2, _corrected(F0, inverse, a, b), weights)
            residual = w * r1 * r2
            floor = self.damping * _positive(weighted_mean(residual[..., None], weights))
            factor = given * w.square() / (residual + floor)
            w1, w2 = _unit_mean(factor * r2.square()), _unit_mean(factor * r1.square())
        return w1, w2

    def _first_line(self, x1: Tensor, x2: Tensor, F0: Tensor, w1: Tensor, w2: Tensor) -> Tensor:
        """Return view 1's line of the rank-2 correction in the whitened coordinates, ``(B, 3)``, unit norm."""
        T1, T2 = self._whiten(x1, x2, w1, w2)
        F_hat = transform_fundamental(F0, torch.linalg.inv_ex(T1)[0], torch.linalg.inv_ex(T2)[0])
        return normalize((T1.mT @ smallest_right_singular_vector(F_hat)[..., None]).squeeze(-1), dim=-1)


def adjugate(A: Tensor) -> Tensor:
    r"""Return the adjugate of matrices :math:`(*, 3, 3)`: :math:`\mathrm{adj}(A)\, A = \det(A)\, I`.

    Example:
        >>> adjugate(torch.diag(torch.tensor([1.0, 2.0, 3.0])))
        tensor([[6., 0., 0.],
                [0., 3., 0.],
                [0., 0., 2.]])

    """
    first, second, third = A.unbind(-1)
    cross = torch.linalg.cross
    return torch.stack([cross(second, third), cross(third, first), cross(first, second)], -2)


def _solve(x: Tensor, w: Tensor, inverse: Tensor, line: Tensor) -> Tensor:
    """The best line of one view for the other view's ``line``: weighted least squares, ``(B, 3)``, unit norm."""
    moments = x.mT @ (w[..., None] * x)
    solution = (adjugate(moments) @ (inverse @ line[..., None])).squeeze(-1)
    # Not `normalize`, whose floor leaves short lines short: from singular moments, shorter with every iteration.
    return solution / _positive(solution.norm(dim=-1, keepdim=True))


def _corrected(F0: Tensor, inverse: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """``F0`` less the multiple of ``a b^T`` that leaves it singular; ``inverse`` is the adjugate of ``F0``."""
    determinant = (inverse[..., 0, :] * F0[..., :, 0]).sum(-1)
    divisor = (b * (inverse @ a[..., None]).squeeze(-1)).sum(-1)
    scale = determinant / torch.where(divisor == 0, 1.0, divisor)
    return F0 - scale[..., None, None] * a[..., :, None] * b[..., None, :]


def line_norms(
    x1: Tensor, x2: Tensor, F_mat: Tensor, weights: Tensor | None = None, floor: float = 1e-3
) -> tuple[Tensor, Tensor]:
    r"""Return the norms of both epipolar lines' normals, :math:`\|(F^\top x_2)_{1:2}\|` and :math:`\|(F x_1)_{1:2}\|`.

    Args:
        x1: homogeneous points of the first view with shape :math:`(*, N, 3)`.
        x2: homogeneous points of the second view with shape :math:`(*, N, 3)`.
        F_mat: fundamental matrices with shape :math:`(*, 3, 3)`.
        weights: optional non-negative weights with shape :math:`(*, N)`; zero means absent.
        floor: share of the set's mean norm added to each, against points on an epipole.

    Returns:
        two tensors with shape :math:`(*, N)`, positive.

    """
    norms = (x2 @ F_mat)[..., :2].norm(dim=-1), (x1 @ F_mat.mT)[..., :2].norm(dim=-1)
    first, second = (n + floor * _positive(weighted_mean(n[..., None], weights)) for n in norms)
    return first, second


def _distance_factor(x1: Tensor, x2: Tensor, F_mat: Tensor, weights: Tensor | None) -> Tensor:
    """Factor from the algebraic residual to the symmetric epipolar distance, ``(*, N)``, with unit mean."""
    first, second = line_norms(x1, x2, F_mat, weights)
    factor = 1 / first + 1 / second
    return factor / _positive(weighted_mean(factor[..., None], weights))


def _hold_undetermined(x1: Tensor, x2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """Cut the derivatives of the samples that do not determine the fundamental matrix; the values stay.

    Where rounding decides on the null vector (at 1e-6, that of float32 pixels), so it does on the weights, and every
    iteration multiplies their derivatives by another inverse of a vanishing number.
    """
    if not (torch.is_grad_enabled() and (x1.requires_grad or x2.requires_grad)):
        return x1, x2, weights
    with torch.no_grad():
        held = ~has_null_vector(design_matrix(x1, x2), weights)[:, None]
    x1, x2 = (torch.where(held[..., None], x.detach(), x) for x in (x1, x2))
    return x1, x2, None if weights is None else torch.where(held, weights.detach(), weights)


def _unit_mean(weights: Tensor) -> Tensor:
    return weights / _positive(weights.mean(-1, keepdim=True))


def _positive(values: Tensor) -> Tensor:
    return torch.where(values > 0, values, 1.0)
