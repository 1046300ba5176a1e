r"""Linear algebra of the DLT: design matrix, null vector, and small matrices.

Every function is batched and has derivatives that stay finite on degenerate input.
"""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import safe_divisor

__all__ = [
    "MIN_GAP",
    "adjugate",
    "cofactors",
    "design_matrix",
    "independence_gap",
    "null_vector",
    "sideways_null_vector",
    "smallest_right_singular_vector",
    "smallest_singular_vectors",
    "solve_null_vector",
]

MIN_GAP = 1e-6  # relative gap above which a null vector counts as unique; that of float32 pixels
MAX_ZERO_VALUE = 1e-10  # relative singular value up to which dependent rows have another null vector


def design_matrix(x1: Tensor, x2: Tensor) -> Tensor:
    r"""Stack the epipolar constraints into the DLT's design matrix.

    Row :math:`i` is :math:`x_{2,i} \otimes x_{1,i}`, so that row times the row-major :math:`\mathrm{vec}(F)` is
    :math:`x_{2,i}^\top F x_{1,i}` (Fan et al., Eq. 3).

    Args:
        x1: homogeneous points of the first view with shape :math:`(*, N, 3)`.
        x2: homogeneous points of the second view with shape :math:`(*, N, 3)`.

    Returns:
        the design matrix with shape :math:`(*, N, 9)`.

    Example:
        >>> design_matrix(torch.tensor([[[1.0, 2.0, 1.0]]]), torch.tensor([[[3.0, 4.0, 1.0]]]))
        tensor([[[3., 6., 3., 4., 8., 4., 1., 2., 1.]]])

    """
    KORNIA_CHECK_SHAPE(x1, ["*", "N", "3"])
    KORNIA_CHECK_SHAPE(x2, ["*", "N", "3"])
    return (x2[..., :, None] * x1[..., None, :]).flatten(-2)


def null_vector(A: Tensor, weights: Tensor | None = None) -> Tensor:
    r"""Return the unit vector :math:`h` that minimises :math:`\sum_i w_i (A_i h)^2`.

    Eight rows have an exact null vector, whatever the positive weights; more rows go to
    :func:`smallest_right_singular_vector`.

    Args:
        A: design matrix with shape :math:`(*, N, 9)`, :math:`N \ge 8`.
        weights: optional non-negative weights with shape :math:`(*, N)`.

    Returns:
        unit vectors with shape :math:`(*, 9)`, sign arbitrary; without gradient where the rows are linearly dependent.

    """
    return solve_null_vector(A, weights)[0]


def solve_null_vector(A: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Return the null vector and the relative gap that tells how well the rows determine it.

    With eight rows, the gap is the smallest distance of a row from the span of the rows before it over the largest such
    distance, both from the QR factorisation of :math:`A^\top` whose last column is the null vector. With more, it is
    the eighth singular value of :math:`\sqrt w A` over the first. Derivatives of the null vector grow as its inverse.

    Args:
        A: design matrices with shape :math:`(*, N, 9)`, :math:`N \ge 8`.
        weights: optional non-negative weights with shape :math:`(*, N)`.

    Returns:
        unit vectors with shape :math:`(*, 9)`, sign arbitrary, and gaps in :math:`[0, 1]` with shape :math:`(*)`,
        without gradient.

    """
    if A.shape[-2] > 8:
        s, Vh = _decompose(A, weights)
        return _attach_derivatives(A, weights, s, Vh), s[..., 7] / safe_divisor(s[..., 0])
    if weights is not None:
        A = A * (weights > 0).to(A)[..., None]
    with torch.no_grad():
        Q, R = torch.linalg.qr(A.mT, mode="complete")
        h0, pivots = Q[..., -1], R.diagonal(dim1=-2, dim2=-1).abs()
        gap = pivots.amin(-1) / safe_divisor(pivots.amax(-1))
        independent = gap > independence_gap(A.dtype)
        scale = torch.where(independent, pivots.amax(-1), 1.0)
    # The linear system [A; h0^T] h = e9, with h0 held fixed, has the solution h0 and gives its derivatives. The
    # substitute enters before the solve and its result is dropped after it: no derivative meets a singular matrix.
    bordered = torch.cat([A / scale[..., None, None], h0[..., None, :]], -2)
    eye = torch.eye(9, dtype=A.dtype, device=A.device)
    bordered = torch.where(independent[..., None, None], bordered, eye)
    h = torch.linalg.solve_ex(bordered, eye[:, 8].expand(*A.shape[:-2], 9).unsqueeze(-1))[0].squeeze(-1)
    return normalize(torch.where(independent[..., None], h, h0), dim=-1), gap


def independence_gap(dtype: torch.dtype) -> float:
    """Return the relative gap up to which rows are linearly dependent but for rounding."""
    return 256 * torch.finfo(dtype).eps


@torch.no_grad()
def sideways_null_vector(A: Tensor) -> Tensor:
    r"""Return the vector of the null space nearest to the matrix of a sideways motion, for linearly dependent rows.

    A null space of more than one dimension leaves the choice to rounding, and so to the processor. This choice does not
    depend on the order of the rows, nor on which view comes first.

    Args:
        A: design matrices with shape :math:`(*, N, 9)`, whose singular values below 1e-10 of the first count as zero.

    Returns:
        unit vectors with shape :math:`(*, 9)`.

    """
    _, s, Vh = torch.linalg.svd(A)
    zero = torch.ones_like(Vh[..., 0], dtype=torch.bool)  # the ninth of eight rows is zero
    zero[..., :8] = s[..., :8] <= MAX_ZERO_VALUE * s[..., :1]
    sideways = A.new_tensor([0.0, 0, 0, 0, 0, 1, 0, -1, 0])
    return normalize(Vh.mT @ (zero * (Vh @ sideways))[..., None], dim=-2).squeeze(-1)


def smallest_right_singular_vector(A: Tensor, weights: Tensor | None = None) -> Tensor:
    r"""Return the unit vector :math:`v` that minimises :math:`\sum_i w_i (A_i v)^2`, twice differentiable.

    The value comes from a singular value decomposition held fixed, :math:`\sqrt{w} A = U \Sigma V^\top`; the
    derivatives from two steps of the perturbation series of the last eigenvector of the Gram matrix, written in the
    basis :math:`V`, where it is diagonal. So the condition number is never squared, other singular values may
    coincide, the weights may be zero, and a last singular value that is not simple sends a zero gradient instead of an
    infinite one.

    Args:
        A: matrices with shape :math:`(*, M, n)`, :math:`M \ge n`.
        weights: optional non-negative weights with shape :math:`(*, M)`.

    Returns:
        unit vectors with shape :math:`(*, n)`, sign arbitrary.

    Example:
        >>> smallest_right_singular_vector(torch.diag(torch.tensor([3.0, 0.5, 2.0]))).abs()
        tensor([0., 1., 0.])

    """
    return _attach_derivatives(A, weights, *_decompose(A, weights))


def smallest_singular_vectors(A: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the left and right singular vectors of the smallest singular value, twice differentiable."""
    with torch.no_grad():
        U, s, Vh = torch.linalg.svd(A)
    return _attach_derivatives(A.mT, None, s, U.mT), _attach_derivatives(A, None, s, Vh)


@torch.no_grad()
def _decompose(A: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return singular values and right singular vectors of ``sqrt(weights) A``."""
    weighted = A if weights is None else A * weights.sqrt()[..., None]
    _, s, Vh = torch.linalg.svd(weighted, full_matrices=False)
    return s, Vh


def _attach_derivatives(A: Tensor, weights: Tensor | None, s: Tensor, Vh: Tensor) -> Tensor:
    """Return the last row of ``Vh`` with its derivatives by ``A`` and the weights."""
    with torch.no_grad():
        gap = s[..., :-1].square() - s[..., -1:].square()
        simple = gap > 64 * torch.finfo(A.dtype).eps * s[..., :-1] * s[..., :1]
        inverse_gap = torch.where(simple, gap, torch.inf).reciprocal()
    C = A @ Vh.mT
    G = C.mT @ (C if weights is None else C * weights[..., None])
    G11, g = G[..., :-1, :-1], G[..., :-1, -1]
    x = -inverse_gap * g
    eigenvalue = G[..., -1:, -1] + (g * x).sum(-1, keepdim=True)
    x = x - inverse_gap * ((G11 @ x[..., None]).squeeze(-1) - eigenvalue * x + g)
    v = (Vh.mT @ torch.cat([x, torch.ones_like(x[..., :1])], -1)[..., None]).squeeze(-1)
    return normalize(v, dim=-1)


def adjugate(A: Tensor) -> Tensor:
    r"""Return the adjugate of matrices :math:`(*, 3, 3)`: :math:`\mathrm{adj}(A)\, A = \det(A)\, I`.

    Example:
        >>> adjugate(torch.diag(torch.tensor([1.0, 2.0, 3.0])))
        tensor([[6., 0., 0.],
                [0., 3., 0.],
                [0., 0., 2.]])

    """
    return cofactors(A).mT


def cofactors(A: Tensor) -> Tensor:
    r"""Return the cofactors of matrices :math:`(*, 3, 3)`, the gradient of the determinant.

    Example:
        >>> cofactors(torch.diag(torch.tensor([1.0, 2.0, 3.0]))).diagonal()
        tensor([6., 3., 2.])

    """
    rows: Tensor = torch.linalg.cross(A.roll(-1, -2), A.roll(-2, -2))
    return rows
