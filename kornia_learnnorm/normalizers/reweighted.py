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
from kornia_learnnorm.geometry.matrices import adjugate, smallest_right_singular_vector_3x3
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
        x = torch.stack([held.x1, held.x2])
        # Hartley's coordinates keep the shape of the pixels, which the distances to lines need.
        T1, T2 = whitening_transform(x[..., :2], self._weigh(x, held)) @ torch.stack([problem.T1, problem.T2])
        return T1, T2

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"iterations={self.iterations}, damping={self.damping:g}"

    def _weigh(self, x: Tensor, problem: LinearProblem) -> Tensor:
        """Return the weights of the last whitening of both views, ``(2, B, N)``, for their points ``(2, B, N, 3)``."""
        weights, F0 = problem.weights, problem.null_matrix
        given: Tensor | float = 1.0 if weights is None else weights
        w = (given * _distance_scale(problem.x1, problem.x2, F0, weights)).expand(x.shape[:-1])
        if self.iterations == 0:
            return w
        # Adjugates stand for inverses: a line has no scale, and they exist where inverses do not.
        inverse = adjugate(F0)
        inverses = torch.stack([inverse, inverse.mT])
        b = _first_line(x, F0, w)
        lines = torch.stack([b, _solve(x[1], w[1], inverse.mT, b)])
        for iteration in range(self.iterations):
            if iteration:
                lines = _solve(x, w, inverses, lines.flip(0))
            b, a = lines
            r = (x @ lines[..., None]).squeeze(-1).abs()
            scale = _distance_scale(problem.x1, problem.x2, _corrected(F0, inverse, a, b), weights)
            residual = scale * r[0] * r[1]
            floor = self.damping * safe_divisor(weighted_mean(residual[..., None], weights))
            factor = given * scale.square() / (residual + floor)
            w = _unit_mean(factor * r.flip(0).square())
        return w


def _first_line(x: Tensor, F0: Tensor, w: Tensor) -> Tensor:
    """Return view 1's line of the rank-2 correction in the coordinates whitened with ``w``, ``(B, 3)``, unit norm."""
    T = whitening_transform(x[..., :2], w)
    F_hat = transform_fundamental(F0, *torch.linalg.inv_ex(T)[0])
    return normalize((T[0].mT @ smallest_right_singular_vector_3x3(F_hat)[..., None]).squeeze(-1), dim=-1)


def _solve(x: Tensor, w: Tensor, inverse: Tensor, line: Tensor) -> Tensor:
    """Return the best line of a view for the other view's ``line``: weighted least squares, ``(*, 3)``, unit norm."""
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
