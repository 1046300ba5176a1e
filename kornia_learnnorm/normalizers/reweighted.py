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
from torch import Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import safe_divisor, weighted_mean
from kornia_learnnorm.geometry.distances import line_norms
from kornia_learnnorm.geometry.dlt import adjugate, smallest_right_singular_vector
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import transform_fundamental, whitening_transform
from kornia_learnnorm.normalizers.contract import ProblemNormalizer

__all__ = ["ReweightedWhitening"]


class ReweightedWhitening(ProblemNormalizer):
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

    min_points = 8

    def __init__(self, iterations: int = 10, damping: float = 0.1) -> None:
        super().__init__()
        if iterations < 0 or damping <= 0:
            raise ValueError(f"iterations must be >= 0 and damping > 0, got {iterations} and {damping}")
        self.iterations = iterations
        self.damping = damping

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        # Where rounding decides on the null vector, it decides on the weights too, and every iteration multiplies their
        # derivatives by another inverse of a vanishing number.
        if torch.is_grad_enabled() and (problem.x1.requires_grad or problem.x2.requires_grad):
            held = problem.detach(~problem.determined)
        else:
            held = problem
        w1, w2 = self._weigh(held)
        # Hartley's coordinates keep the shape of the pixels, which the distances to lines need.
        T1, T2 = whitening_transform(held.x1[..., :2], w1), whitening_transform(held.x2[..., :2], w2)
        return T1 @ problem.T1, T2 @ problem.T2

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"iterations={self.iterations}, damping={self.damping:g}"

    def _weigh(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the weights of the last whitening, of both views, ``(B, N)``."""
        x1, x2, weights, F0 = problem.x1, problem.x2, problem.weights, problem.null_matrix
        given: Tensor | float = 1.0 if weights is None else weights
        w1 = w2 = given * _distance_scale(x1, x2, F0, weights)
        if self.iterations == 0:
            return w1, w2
        # Adjugates stand for inverses: a line has no scale, and they exist where inverses do not.
        inverse = adjugate(F0)
        b = _first_line(x1, x2, F0, w1)
        a = _solve(x2, w2, inverse.mT, b)
        for iteration in range(self.iterations):
            if iteration:
                b, a = _solve(x1, w1, inverse, a), _solve(x2, w2, inverse.mT, b)
            r1, r2 = (x1 @ b[..., None]).squeeze(-1).abs(), (x2 @ a[..., None]).squeeze(-1).abs()
            w = _distance_scale(x1, x2, _corrected(F0, inverse, a, b), weights)
            residual = w * r1 * r2
            floor = self.damping * safe_divisor(weighted_mean(residual[..., None], weights))
            factor = given * w.square() / (residual + floor)
            w1, w2 = _unit_mean(factor * r2.square()), _unit_mean(factor * r1.square())
        return w1, w2


def _first_line(x1: Tensor, x2: Tensor, F0: Tensor, w: Tensor) -> Tensor:
    """Return view 1's line of the rank-2 correction in the coordinates whitened with ``w``, ``(B, 3)``, unit norm."""
    T1, T2 = whitening_transform(x1[..., :2], w), whitening_transform(x2[..., :2], w)
    F_hat = transform_fundamental(F0, torch.linalg.inv_ex(T1)[0], torch.linalg.inv_ex(T2)[0])
    return normalize((T1.mT @ smallest_right_singular_vector(F_hat)[..., None]).squeeze(-1), dim=-1)


def _solve(x: Tensor, w: Tensor, inverse: Tensor, line: Tensor) -> Tensor:
    """Return the best line of one view for the other view's ``line``: weighted least squares, ``(B, 3)``, unit norm."""
    moments = x.mT @ (w[..., None] * x)
    solution = (adjugate(moments) @ (inverse @ line[..., None])).squeeze(-1)
    # Not `normalize`, whose floor leaves short lines short: from singular moments, shorter with every iteration.
    return solution / safe_divisor(solution.norm(dim=-1, keepdim=True))


def _corrected(F0: Tensor, inverse: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return ``F0`` less the multiple of ``a b^T`` that leaves it singular; ``inverse`` is the adjugate of ``F0``."""
    determinant = (inverse[..., 0, :] * F0[..., :, 0]).sum(-1)
    divisor = (b * (inverse @ a[..., None]).squeeze(-1)).sum(-1)
    scale = determinant / torch.where(divisor == 0, 1.0, divisor)
    return F0 - scale[..., None, None] * a[..., :, None] * b[..., None, :]


def _distance_scale(x1: Tensor, x2: Tensor, F_mat: Tensor, weights: Tensor | None) -> Tensor:
    """Return the scale from the algebraic residual to the symmetric epipolar distance, ``(*, N)``, with unit mean."""
    first, second = line_norms(x1, x2, F_mat, weights)
    factor = 1 / first + 1 / second
    return factor / safe_divisor(weighted_mean(factor[..., None], weights))


def _unit_mean(weights: Tensor) -> Tensor:
    return weights / safe_divisor(weights.mean(-1, keepdim=True))
