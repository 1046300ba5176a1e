r"""Linear algebra of the DLT: design matrices, null vectors and null spaces, second moments of rows and steps on them.

Every function is batched and has derivatives that stay finite on degenerate input.
"""

from collections.abc import Callable

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.geometry.checks import needs_gradient, read_condition

MIN_GAP = 1e-6  # relative gap above which a null vector counts as unique; that of float32 pixels
MIN_GRAM_RATIO = 1e-5  # of the last but one singular value to the first; below, a Gram matrix has lost too many digits
# Generic numbers: no null vector of note is orthogonal to them.
NINTH_ROW = (0.118, -0.264, 0.354, -0.028, -0.41, 0.208, -0.174, 0.444, 0.062)
# Relative gap up to which rows are linearly dependent but for rounding.
DEPENDENT_GAP = {dtype: 256 * torch.finfo(dtype).eps for dtype in (torch.float32, torch.float64)}
MAX_ZERO_VALUE = 1e-10  # relative singular value up to which dependent rows have another null vector
DAMPING = 1e-9  # of the mean diagonal of the normal matrix, added to it


def design_matrix(x1: Tensor, x2: Tensor) -> Tensor:
    r"""Stack the epipolar constraints into the DLT's design matrix.

    Row :math:`i` is :math:`x_{2,i} \otimes x_{1,i}`, so that row times the row-major :math:`\mathrm{vec}(F)` is
    :math:`x_{2,i}^\top F x_{1,i}` (Fan et al., Eq. 2).

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
    # On a CPU, products along the points are faster than those along the columns.
    return (x2.mT.unsqueeze(-2) * x1.mT.unsqueeze(-3)).flatten(-3, -2).mT


def solve_rows(
    A: Tensor, weights: Tensor | None = None, product: Callable[[Tensor], Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    r"""Return the null vectors :math:`(*, 9)` of design matrices :math:`(*, N, 9)`, and their relative gaps.

    They are the unit vectors :math:`h` of least :math:`\sum_i w_i (A_i h)^2`, of any sign. Eight rows have exact ones,
    whatever the positive weights; their relative gap, from 0 to 1, is the smallest pivot over the largest of the LU
    factorisation of :math:`A^\top` with partial pivoting. Of more, it is the eighth singular value of :math:`\sqrt w A`
    over the first. Derivatives of the null vector grow as its inverse; the gap has none.

    ``product`` multiplies vectors :math:`(*, 9)` by :math:`A^\top W A` of more than eight rows and has the derivatives,
    where there is a cheaper way than through ``A``.
    """
    if A.shape[-2] == 8:
        return _null_vector_of_eight(A, weights)

    def gram_product(v: Tensor) -> Tensor:
        residual = A @ v[..., None]
        return (A.mT @ (residual if weights is None else residual * weights[..., None]))[..., 0]

    h, s = _smallest(A, weights, product or gram_product)
    return h, s[..., 7] / (s[..., 0] + (s[..., 0] == 0))


def _null_vector_of_eight(A: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return null vectors (*, 9) of eight rows and relative gaps (*)."""
    if weights is not None:
        A = A * (weights > 0).to(A)[..., None]
    derivatives = needs_gradient(A)
    with torch.no_grad():
        h0, pivots = _eliminate(A.detach() if derivatives else A)  # `no_grad` leaves forward-mode derivatives
        largest = pivots.amax(-1)
        gap = pivots.amin(-1) / (largest + (largest == 0))
    if not derivatives:
        return h0, gap
    # The linear system [A; h0^T] h = e9, with h0 held fixed, has the solution h0 and gives its derivatives. The
    # substitute enters before the solve and its result is dropped after it: no derivative meets a singular matrix.
    independent = gap > DEPENDENT_GAP[A.dtype]
    scale = torch.where(independent, largest, 1.0)
    bordered = torch.cat([A / scale[..., None, None], h0[..., None, :]], -2)
    eye = torch.eye(9, dtype=A.dtype, device=A.device)
    bordered = torch.where(independent[..., None, None], bordered, eye)
    h = torch.linalg.solve_ex(bordered, eye[:, 8].expand(*A.shape[:-2], 9).unsqueeze(-1))[0].squeeze(-1)
    h = normalize(torch.where(independent[..., None], h, h0), dim=-1)
    return h0 + (h - h.detach()), gap  # the values do not depend on whether derivatives are wanted


def _eliminate(A: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return unit null vectors (*, 9) of eight rows and the magnitudes of the pivots (*, 8).

    With a ninth row :math:`r` that is the same for all, the LU factorisation of :math:`[A^\top\; r]` gives the pivots
    of the eight rows, and the solution of :math:`[A; r^\top] h = e_9` up to scale. The residual is as small as rounding
    allows, whatever :math:`r`. A vanishing pivot is replaced by what rounding leaves: of several null vectors the
    solution is one.
    """
    r = A.new_tensor(NINTH_ROW).expand(*A.shape[:-2], 1, 9)
    LU, permutation, _ = torch.linalg.lu_factor_ex(torch.cat([A, r], -2).mT)
    diagonal = LU.diagonal(dim1=-2, dim2=-1)
    pivots = diagonal.abs()
    least = torch.finfo(A.dtype).eps * pivots.amax(-1, keepdim=True)
    diagonal.copy_(torch.where(pivots < least, least + (least == 0), diagonal))
    last = torch.eye(9, dtype=A.dtype, device=A.device)[:, 8:].expand(*A.shape[:-2], 9, 1)
    return normalize(torch.linalg.lu_solve(LU, permutation, last, adjoint=True)[..., 0], dim=-1), pivots[..., :8]


def null_space(A: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return bases :math:`(*, 9, 9 - M)` of the null spaces of M rows, M < 9, and the magnitudes of M pivots.

    The LU factorisation :math:`A^\top = P L U` gives :math:`P\,(-L_2 L_1^{-1}\;\; I)^\top`, of the first M rows
    :math:`L_1` of :math:`L` and the others, which is not orthonormal.
    """
    number = A.shape[-2]
    square = torch.cat([A, A.new_zeros(*A.shape[:-2], 9 - number, 9)], -2).mT  # a GPU factorises these all at once
    LU, permutation, _ = torch.linalg.lu_factor_ex(square)
    L1, L2 = LU[..., :number, :number], LU[..., number:, :number]
    upper = -torch.linalg.solve_triangular(L1.mT, L2.mT, upper=True, unitriangular=True)
    lower = torch.eye(9 - number, dtype=A.dtype, device=A.device).expand(*A.shape[:-2], -1, -1)
    P, _, _ = torch.lu_unpack(LU, permutation, unpack_data=False)
    return P @ torch.cat([upper, lower], -2), LU.diagonal(dim1=-2, dim2=-1)[..., :number].abs()


@torch.no_grad()
def nearest_null_vector(A: Tensor, preferred: Tensor) -> Tensor:
    """Return the unit vectors :math:`(*, 9)` of the null spaces nearest to a preferred one, for dependent rows.

    A null space of more than one dimension leaves the choice to rounding, and so to the processor. This choice does not
    depend on the order of the rows, nor, where the preferred matrix is symmetric in the views, on which comes first.
    """
    _, s, Vh = torch.linalg.svd(A)
    zero = torch.ones_like(Vh[..., 0], dtype=torch.bool)  # the ninth of eight rows is zero
    zero[..., :8] = s[..., :8] <= MAX_ZERO_VALUE * s[..., :1]
    return normalize(Vh.mT @ (zero * (Vh @ preferred))[..., None], dim=-2).squeeze(-1)


def _smallest(A: Tensor, weights: Tensor | None, product: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Return the last right singular vectors of ``sqrt(weights) A``, twice differentiable, and all singular values.

    The eigenvectors of the Gram matrix are a start, and where it has lost the digits of small singular values, those of
    the singular value decomposition. A Newton step with ``product``, which multiplies vectors by the Gram matrix and
    has the derivatives, brings the digits back, and two more give the derivatives. A last singular value that is not
    simple sends a zero gradient instead of an infinite one.
    """
    derivatives = needs_gradient(A, weights)
    with torch.no_grad():  # which leaves forward-mode derivatives
        fixed, shares = A.detach() if derivatives else A, weights
        if derivatives and shares is not None:
            shares = shares.detach()
        values, vectors = torch.linalg.eigh(fixed.mT @ (fixed if shares is None else fixed * shares[..., None]))
        s, Vh = values.clamp(min=0).sqrt().flip(-1), vectors.mT.flip(-2)
        precise = s[..., -2] > MIN_GRAM_RATIO * s[..., 0]
        if not read_condition(precise.all()):
            rooted = fixed if shares is None else fixed * shares.sqrt()[..., None]
            _, s_exact, Vh_exact = torch.linalg.svd(rooted, full_matrices=False)
            s, Vh = torch.where(precise[..., None], s, s_exact), torch.where(precise[..., None, None], Vh, Vh_exact)
        others, v = Vh[..., :-1, :], Vh[..., -1, :]
        gap = s[..., :-1].square() - s[..., -1:].square()
        simple = gap > 64 * torch.finfo(A.dtype).eps * s[..., :-1] * s[..., :1]
        inverse_gap = torch.where(simple, gap, torch.inf).reciprocal()
        image = product(v)
        v = normalize(_newton_step(v, image.detach() if derivatives else image, others, inverse_gap), dim=-1)
    if not derivatives:
        return v, s
    x = v
    for _ in range(2):  # each makes the derivatives of one more order right
        x = _newton_step(x, product(x), others, inverse_gap)
    x = normalize(x, dim=-1)
    return v + (x - x.detach()), s  # the values do not depend on whether derivatives are wanted


def _newton_step(v: Tensor, image: Tensor, others: Tensor, inverse_gap: Tensor) -> Tensor:
    """Return the vector after a step to the last eigenvector of a Gram matrix, of which ``image`` is the product."""
    image = image - (v * image).sum(-1, keepdim=True) / (v * v).sum(-1, keepdim=True) * v
    return v - (others.mT @ (inverse_gap * (others @ image[..., None])[..., 0])[..., None])[..., 0]


def point_products(x1: Tensor, x2: Tensor) -> Tensor:
    r"""Return the six different entries of :math:`x_1 x_1^\top`, then those of view 2, of points (\*, 3, N)."""
    first, second = _PAIRS.to(x1.device)
    x = torch.stack([x1, x2], -3)
    return (x[..., first, :] * x[..., second, :]).flatten(-3, -2)


def row_products(products: Tensor) -> Tensor:
    r"""Return the 36 different entries of :math:`a a^\top` of rows :math:`a = x_1 \otimes x_2`, (\*, 36, N).

    ``products`` (\*, 12, N) are those of :func:`point_products`.
    """
    first, second = products.chunk(2, -2)
    return (first[..., :, None, :] * second[..., None, :, :]).flatten(-3, -2)


def row_moments(weights: Tensor, products: Tensor) -> Tensor:
    r"""Return :math:`\sum_i w_i a_i a_i^\top`, (\*, S, 9, 9), of weights (\*, S, N) and :func:`row_products`."""
    return torch.unflatten((weights @ products.mT) @ _ROW_ENTRIES.to(weights), -1, (9, 9))


def normal_equations(M: Tensor, pull: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normal matrices (B, P, P) of steps along tangents, a little damped, and the gradients (B, P, 1).

    ``pull`` (B, 9, 1) is half of the derivative of the cost by the entries.
    """
    along = tangents.mT
    normal = along @ M @ tangents
    diagonal = normal.diagonal(dim1=-2, dim2=-1)
    diagonal += DAMPING * diagonal.mean(-1, keepdim=True) + torch.finfo(M.dtype).tiny
    return normal, along @ pull


_PAIRS = torch.triu_indices(3, 3)
# From the different entries of a symmetric matrix, (3, 3) and of rows (9, 9), to all of them.
ENTRIES = torch.eye(6, dtype=torch.float64)[torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])]
_ROW_ENTRIES = torch.einsum("pqs,abt->stpaqb", ENTRIES, ENTRIES).reshape(36, 81).contiguous()
