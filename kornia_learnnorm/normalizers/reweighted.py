r"""Whitening reweighted by the epipolar geometry, which improves the rank-2 projection in closed form.

The projection to rank 2 subtracts :math:`\sigma\, a b^\top` from the null vector of eight points, which leaves
correspondence :math:`i` the residual :math:`\sigma\, (a^\top x_{2,i}) (b^\top x_{1,i})`. The normalisation only affects
the lines :math:`a` and :math:`b`. For a given line, the best other one is a weighted least-squares solution. Both are
optimal where they are singular vectors in whitened coordinates, so alternating least squares is iterated whitening.
"""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import needs_gradient, safe_divisor
from kornia_learnnorm.geometry.matrices import cofactors, smallest_right_singular_vector
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import transform_fundamental, whitening_from_moments
from kornia_learnnorm.normalizers.normalizer import ProblemNormalizer

__all__ = ["ReweightedWhitening"]

# A symmetric matrix of three rows as six entries, row by row. Its cofactors, in the same order, are products of two
# entries less products of two others: one factor of all six, then another, twice.
MINORS = (3, 2, 1, 0, 1, 0, 5, 4, 4, 5, 2, 3, 4, 1, 2, 2, 0, 1, 4, 5, 3, 2, 4, 1)
ENTRIES = (0, 1, 2, 1, 3, 4, 2, 4, 5)  # of the whole matrix
NORMAL_FLOOR = 1e-3  # share of the mean norm of the lines' normals, added to each against points on an epipole


class ReweightedWhitening(ProblemNormalizer):
    r"""Whitening with weights that make the rank-2 projection minimise the symmetric epipolar distance.

    It starts from the DLT's null vector :math:`F_0` and the weights
    :math:`w_i = 1 / \|(F_0^\top x_{2,i})_{1:2}\| + 1 / \|(F_0 x_{1,i})_{1:2}\|`, the factor from an algebraic residual
    to the symmetric epipolar distance (Fan et al., Eq. 8). Each iteration finds the lines :math:`a, b` of the rank-2
    correction, :math:`b \propto S_1^{-1} F_0^{-1} a` and :math:`a \propto S_2^{-1} F_0^{-\top} b`, and sets the weights
    of view 1 to :math:`w_i |a^\top x_{2,i}| / |b^\top x_{1,i}|`, of view 2 to its mirror image: iteratively reweighted
    least squares for the sum of absolute residuals. Both views are updated at the same time, so that swapping them
    swaps the transforms.

    Args:
        iterations: number of reweightings; 0 whitens with the initial :math:`w`. ValueError for a negative number.
        damping: share of the mean residual added to each residual before it divides; ValueError unless positive.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> T1, T2 = ReweightedWhitening()(torch.rand(2, 8, 2), torch.rand(2, 8, 2))
        >>> T1.shape
        torch.Size([2, 3, 3])
    """

    min_points = 8

    def __init__(self, iterations: int = 10, damping: float = 0.1) -> None:
        super().__init__()
        if iterations < 0 or not damping > 0:
            raise ValueError(f"iterations must be >= 0 and damping > 0, got {iterations} and {damping}")
        self.iterations, self.damping = iterations, damping

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        # Where rounding decides the null vector, it decides the weights too, and every iteration would divide their
        # derivatives by another vanishing number.
        held = problem.detach(~problem.determined) if needs_gradient(problem.x1, problem.x2) else problem
        # Hartley's transform is a similarity, so distances to lines are those in pixels up to scale.
        # The batch comes last, (2, N, 2, B) for coordinates and views: every operation runs along contiguous memory.
        points = torch.stack([held.x1, held.x2])[..., :2].permute(3, 2, 0, 1).contiguous()
        T1, T2 = _whitening(points, self._weigh(points, held)) @ torch.stack([problem.T1, problem.T2])
        return T1, T2

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"iterations={self.iterations}, damping={self.damping:g}"

    def _weigh(self, points: Tensor, problem: LinearProblem) -> Tensor:
        """Return the weights of the last whitening of both views, ``(N, 2, B)``, for their points ``(2, N, 2, B)``."""
        F0 = problem.null_matrix
        weights = None if problem.weights is None else problem.weights.mT[:, None]
        # Weights that sum to one, for means.
        share = None if weights is None else weights / safe_divisor(weights.sum(0))
        both = torch.stack([F0, F0.mT]).permute(2, 3, 0, 1).contiguous()
        normals = _evaluate(both[:, :2], points.flip(-2))  # of the epipolar lines in both views, (2, N, 2, B)
        w = _distance_scale(normals, share).expand(points.shape[1:])
        if weights is not None:
            w = w * weights
        if self.iterations == 0:
            return w
        # Adjugates replace inverses: lines are defined up to scale, and adjugates exist where inverses do not.
        inverse = cofactors(F0).mT
        inverses = torch.stack([inverse, inverse.mT]).permute(2, 3, 0, 1).contiguous()
        determinant = (inverse[..., 0, :] * F0[..., :, 0]).sum(-1)
        x, y = points.unbind(0)
        products = torch.stack([x * x, x * y, x, y * y, y, torch.ones_like(x)], 1)
        indices = torch.tensor(MINORS, device=w.device), torch.tensor(ENTRIES, device=w.device)
        # View 1's line of the rank-2 correction in the coordinates whitened with w.
        T = _whitening(points, w)
        v = smallest_right_singular_vector(transform_fundamental(F0, *cofactors(T).mT))[0]
        b = normalize((T[0].mT @ v[..., None]).squeeze(-1), dim=-1)
        a = _best_line(products[..., 1, :], w[:, 1], (inverse.mT @ b[..., None])[..., 0].mT, *indices)
        lines = torch.stack([b.mT, a], 1)
        for iteration in range(self.iterations):
            target = (inverses * lines.flip(1)).sum(1)
            # F0 - size a b^T is singular. It turns a view's epipolar line by the distance of the other view's point.
            divisor = (lines[:, 0] * target[:, 0]).sum(0)
            size = determinant / torch.where(divisor == 0, 1.0, divisor)
            r = _evaluate(lines, points).flip(1)
            scale = _distance_scale(normals - size * r * lines[:2, None], share)
            residual = scale * (r[:, :1] * r[:, 1:]).abs()
            floor = self.damping * safe_divisor(_mean(residual, share))
            factor = scale.square() / (residual + floor)
            w = (factor if weights is None else factor * weights) * r.square()
            if iteration + 1 < self.iterations:
                lines = _best_line(products, w, target, *indices)
        return w


def _whitening(points: Tensor, w: Tensor) -> Tensor:
    """Return the whitening transforms ``(2, B, 3, 3)`` of points ``(2, N, 2, B)`` with weights ``(N, 2, B)``."""
    total = w.sum(0)
    w = (w + (total == 0)) / (total + w.shape[0] * (total == 0))
    weighted = w * points
    mean = weighted.sum(1)
    x, y = (weighted - w * mean[:, None]).unbind(0)
    a, b, c = (x * points[0]).sum(0), (x * points[1]).sum(0), (y * points[1]).sum(0)
    covariance = torch.unflatten(torch.stack([a, b, b, c], -1), -1, (2, 2))
    return whitening_from_moments(torch.stack([*mean], -1), covariance)


def _evaluate(lines: Tensor, points: Tensor) -> Tensor:
    """Return the products of lines ``(3, *, B)`` and homogeneous points, given as ``(2, N, *, B)``."""
    a, b, c = lines.unsqueeze(-3).unbind(0)
    return torch.addcmul(torch.addcmul(c, a, points[0]), b, points[1])


def _best_line(products: Tensor, w: Tensor, target: Tensor, minors: Tensor, entries: Tensor) -> Tensor:
    """Return the line :math:`S^{-1} t` of unit norm, ``(3, *)``, with the second moments :math:`S` of weighted points.

    ``products`` are those of the points' homogeneous coordinates, six, ``(N, 6, *)``, and weights ``(N, *)``.
    """
    moments = (products * w[:, None]).sum(0)
    p, q, r, s = torch.unflatten(moments.index_select(0, minors), 0, (4, 6)).unbind(0)
    inverse = torch.addcmul(p * q, r, s, value=-1).index_select(0, entries)
    line = (torch.unflatten(inverse, 0, (3, 3)) * target).sum(1)
    # Not `normalize`, which clamps tiny norms: lines of singular moments would get shorter with every iteration.
    return line / safe_divisor(line.square().sum(0)).sqrt()


def _distance_scale(normals: Tensor, share: Tensor | None) -> Tensor:
    """Return the scale from the algebraic residual to the symmetric epipolar distance, ``(N, 1, B)``."""
    square = normals.square().sum(0)
    zero = square == 0
    norms = (square + zero).sqrt() * ~zero  # the root of zero has no derivative
    norms = norms + NORMAL_FLOOR * safe_divisor(_mean(norms, share))
    return norms.reciprocal().sum(1, keepdim=True)


def _mean(values: Tensor, share: Tensor | None) -> Tensor:
    return values.mean(0) if share is None else (values * share).sum(0)
