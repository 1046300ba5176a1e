r"""Closed forms for matrices of three rows and columns: cofactors, and the vectors of the smallest singular value.

A batch of them costs a few elementwise operations, where a decomposition loops over the batch.
"""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import needs_gradient

RANK1_WEIGHT = 1e-27  # of the complement of the rows, above the square of what rounding leaves of vanishing cofactors
EPSILON = 1e-15  # of the mean eigenvalue, which a threefold one leaves of itself
COLUMN_PREFERENCE = 1.1893  # of the last diagonal entry over the first: equal entries are not tied
MIN_RELATIVE_GAP = 1e-10  # of the two largest eigenvalues of the cofactors' Gram matrix, for a unique vector


def cofactors(A: Tensor) -> Tensor:
    """Return the cofactors of matrices :math:`(*, 3, 3)`, the gradient of the determinant."""
    rows: Tensor = torch.linalg.cross(A.roll(-1, -2), A.roll(-2, -2))
    return rows


def determinant(A: Tensor) -> Tensor:
    """Return the determinants of matrices :math:`(*, 3, 3)`."""
    value: Tensor = (A[..., 0, :] * torch.linalg.cross(A[..., 1, :], A[..., 2, :])).sum(-1)
    return value


def inverse(A: Tensor) -> Tensor:
    """Return the inverses of matrices :math:`(*, 3, 3)`."""
    C = cofactors(A)
    return C.mT / (A[..., 0, :] * C[..., 0, :]).sum(-1)[..., None, None]


def nearest_rank2(A: Tensor) -> Tensor:
    r"""Return the nearest matrices of rank 2 in Frobenius norm to matrices :math:`(*, 3, 3)`, twice differentiable.

    :math:`A - A v v^\top` with the right singular vector :math:`v` of the smallest singular value.
    """
    v = smallest_right_singular_vector(A)[0][..., None]
    return A - (A @ v) @ v.mT


def unit_matrix(M: Tensor) -> Tensor:
    """Return matrices :math:`(*, 3, 3)` scaled to unit Frobenius norm, with a canonical sign.

    Of the entries of at least half of the largest magnitude, the first in row-major order is positive. The sign does
    not depend on rounding, also where two entries are equal up to their signs, as under pure translation.
    """
    entries = M.detach().flatten(-2)
    size = entries.abs()
    large = torch.where(size >= size.amax(-1, keepdim=True) / 2, entries.sign(), 0.0)
    powers = torch.arange(8, -1, -1, dtype=M.dtype, device=M.device).exp2()  # the first outweighs all others
    sign = torch.where(large @ powers < 0, -1.0, 1.0)[..., None, None]
    return torch.mul(M, sign / torch.linalg.matrix_norm(M, keepdim=True))


def smallest_right_singular_vector(A: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the right singular vector :math:`(*, 3)` of the smallest singular value, and the cofactors up to scale.

    The cofactors :math:`C = \det(A) A^{-\top}` have the singular vectors of :math:`A`, with singular values
    :math:`\sigma_1 \sigma_2 \ge \sigma_1 \sigma_3 \ge \sigma_2 \sigma_3`. So the vector belongs to the **largest**
    eigenvalue of :math:`C^\top C`, which the trigonometric solution of the characteristic polynomial gives with all its
    digits: no condition number is squared. Its sign is arbitrary, and it is twice differentiable. Where the smallest
    singular value is not simple it is one of its vectors and sends no gradient.
    """
    peak = A.detach().abs().amax((-2, -1), keepdim=True)
    A = A / (peak + (peak == 0))  # a norm could over- or underflow
    norm = torch.linalg.matrix_norm(A.detach(), keepdim=True)
    A = A / (norm + (norm == 0))
    C: Tensor = torch.linalg.cross(A.roll(-1, -2), A.roll(-2, -2))  # cofactors
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    # All that a matrix of rank one leaves are the vectors orthogonal to its rows.
    M = C.mT @ C + RANK1_WEIGHT * (eye - A.mT @ A)
    derivatives = needs_gradient(M)
    fixed = M.detach() if derivatives else M  # `no_grad` leaves forward-mode derivatives
    with torch.no_grad():
        v, largest = _largest_eigenvector(fixed)
    if not derivatives:
        return v, C
    with torch.no_grad():
        # The inverse of H on the complement of its null vector v, where it has two eigenvalues: (tr H - H) / product.
        H = largest * eye - fixed
        trace = H.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        product = (trace.square() - H.square().sum((-2, -1), keepdim=True)) / 2
        simple = product > MIN_RELATIVE_GAP * largest * trace
        P = eye - v[..., :, None] * v[..., None, :]
        inverse = torch.where(simple, (trace * P - H) / torch.where(simple, product, 1.0), 0.0)
    x = v
    for _ in range(2):  # Newton's steps from the solution; each makes the derivatives of one more order right
        image = (M @ x[..., None])[..., 0]
        eigenvalue = (x * image).sum(-1, keepdim=True) / (x * x).sum(-1, keepdim=True)
        x = x + (inverse @ (image - eigenvalue * x)[..., None])[..., 0]
    x = normalize(x, dim=-1)
    return v + (x - x.detach()), C  # the values do not depend on whether derivatives are wanted


def _largest_eigenvector(M: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit vectors (*, 3) and eigenvalues (*, 1, 1) of positive semidefinite matrices."""
    # The batch comes last: on a CPU, operations along it are several times faster than along three entries.
    M = M.movedim((-2, -1), (0, 1)).contiguous()
    eye = torch.eye(3, dtype=M.dtype, device=M.device).view(3, 3, *[1] * (M.ndim - 2))
    mean = M.diagonal().sum(-1) / 3
    B = M - mean * eye
    spread = (B.square().sum((0, 1)) / 6).sqrt()
    B = B / (spread + (spread == 0))
    cosine = ((B[0] * torch.linalg.cross(B[1], B[2], dim=0)).sum(0) / 2).clamp(-1, 1)
    largest = mean + 2 * spread * torch.cos(torch.acos(cosine) / 3)
    shifted = M - largest * eye
    columns = torch.linalg.cross(shifted.roll(-1, 0), shifted.roll(-2, 0), dim=1)  # a multiple of v v^T
    # Of a double largest eigenvalue nothing is left; less the smallest one, all columns of M are its vectors.
    smallest = (1 - EPSILON) * mean - 2 * spread
    unique = columns.diagonal().amax(-1) > MIN_RELATIVE_GAP * largest.square()
    columns = torch.where(unique, columns, M - smallest * eye)
    # The column of about the largest diagonal entry. Columns of equal entries must not add up: they may cancel.
    size = columns.diagonal() * torch.linspace(1.0, COLUMN_PREFERENCE, 3, dtype=M.dtype, device=M.device)
    best = (size == size.amax(-1, keepdim=True)).movedim(-1, 0)
    v = (M * (columns * best).sum(1)).sum(1)
    norm = torch.linalg.vector_norm(v, dim=0)
    return (v / (norm + (norm == 0))).movedim(0, -1), largest[..., None, None]
