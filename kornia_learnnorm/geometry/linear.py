r"""The steps of the linear solver: design matrix, null vector, rank-2 projection.

Every step is batched and has derivatives that stay finite on degenerate input.
"""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor
from torch.nn.functional import normalize

__all__ = ["design_matrix", "has_null_vector", "null_vector", "rank2_projection", "smallest_right_singular_vector"]


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

    Eight rows have an exact null vector, whatever the positive weights: it comes from a QR factorisation of
    :math:`A^\top`, and from the linear system :math:`[A; h_0^\top]\, h = e_9`, in which :math:`h_0` is that vector held
    fixed, it gets its derivatives. More rows go to :func:`smallest_right_singular_vector`.

    Args:
        A: design matrix with shape :math:`(*, N, 9)`, :math:`N \ge 8`.
        weights: optional non-negative weights with shape :math:`(*, N)`.

    Returns:
        unit vectors with shape :math:`(*, 9)`, sign arbitrary; without gradient where the rows are linearly dependent.

    """
    if A.shape[-2] > 8:
        return smallest_right_singular_vector(A, weights)
    if weights is not None:
        A = A * (weights > 0).to(A)[..., None]
    with torch.no_grad():
        Q, R = torch.linalg.qr(A.mT, mode="complete")
        h0 = Q[..., -1]
        pivots = R.diagonal(dim1=-2, dim2=-1).abs()
        scale = pivots.amax(-1)
        determined = pivots.amin(-1) > 64 * torch.finfo(A.dtype).eps * scale
        scale = torch.where(determined, scale, 1.0)
    bordered = torch.cat([A / scale[..., None, None], h0[..., None, :]], -2)
    # The substitute enters before the solve and its result is dropped after it: no derivative ever meets a singular
    # matrix.
    eye = torch.eye(9, dtype=A.dtype, device=A.device)
    bordered = torch.where(determined[..., None, None], bordered, eye)
    h = torch.linalg.solve_ex(bordered, eye[:, 8].expand(*A.shape[:-2], 9).unsqueeze(-1))[0].squeeze(-1)
    h = torch.where(determined[..., None], h, h0)
    return normalize(h, dim=-1)


def has_null_vector(A: Tensor, weights: Tensor | None = None, tolerance: float = 1e-6) -> Tensor:
    r"""Tell the design matrices that determine their null vector, up to its sign.

    With eight rows, the distance of each from the span of those before it must exceed a share of the largest such
    distance; with more, the eighth singular value of :math:`\sqrt w A` must exceed that share of the first. Derivatives
    of the null vector grow as the inverse of what is compared.

    Args:
        A: design matrices in normalised coordinates with shape :math:`(*, N, 9)`, :math:`N \ge 8`.
        weights: optional non-negative weights with shape :math:`(*, N)`.
        tolerance: the share.

    Returns:
        booleans with shape :math:`(*)`.

    Example:
        >>> has_null_vector(torch.stack([torch.eye(9)[:8], torch.ones(8, 9)]))
        tensor([ True, False])

    """
    if A.shape[-2] == 8:
        A = A if weights is None else A * (weights > 0).to(A)[..., None]
        values = torch.linalg.qr(A.mT, mode="r")[1].diagonal(dim1=-2, dim2=-1).abs()
    else:
        A = A if weights is None else A * weights.sqrt()[..., None]
        values = torch.linalg.svdvals(A)[..., :8]
    determined: Tensor = values.amin(-1) > tolerance * values.amax(-1)
    return determined


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
    with torch.no_grad():
        weighted = A if weights is None else A * weights.sqrt()[..., None]
        _, s, Vh = torch.linalg.svd(weighted, full_matrices=False)
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


def rank2_projection(F_mat: Tensor) -> Tensor:
    r"""Project matrices on the nearest rank-2 matrices in Frobenius norm.

    :math:`F - F v v^\top`, with :math:`v` the right singular vector of the smallest singular value (the singularity
    constraint, Fan et al., section 3, step 2b).

    Args:
        F_mat: matrices with shape :math:`(*, 3, 3)`.

    Returns:
        matrices of rank 2 with shape :math:`(*, 3, 3)`.

    Example:
        >>> rank2_projection(torch.diag(torch.tensor([3.0, 2.0, 1.0])))
        tensor([[3., 0., 0.],
                [0., 2., 0.],
                [0., 0., 0.]])

    """
    KORNIA_CHECK_SHAPE(F_mat, ["*", "3", "3"])
    v = smallest_right_singular_vector(F_mat)[..., None]
    return F_mat - (F_mat @ v) @ v.mT
