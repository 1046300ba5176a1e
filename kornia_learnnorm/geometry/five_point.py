r"""Essential matrices in the span of four matrices: the null space of five correspondences, or of the best of many.

A matrix :math:`E = x E_0 + y E_1 + z E_2 + E_3` is essential where ten cubic polynomials in :math:`x, y, z` vanish,
:math:`\det E = 0` and :math:`2 E E^\top E - \mathrm{tr}(E E^\top) E = 0` (D. Nister, An efficient solution to the
five-point relative pose problem, TPAMI 2004). Elimination of the ten cubic monomials leaves the matrix that multiplies
by :math:`x` the ten others; its eigenvectors are their values at the solutions (H. Stewenius, C. Engels, D. Nister,
Recent developments on direct relative orientation, ISPRS 2006).
"""

from itertools import product

import torch
from torch import Tensor

# Exponents of x, y and z: the cubic monomials, then the others, which the eigenvectors hold.
MONOMIALS = sorted((m for m in product(range(4), repeat=3) if sum(m) <= 3), key=lambda m: (-sum(m), [-e for e in m]))
MAX_IMAGINARY = 1e-6  # relative imaginary part of a real solution


_FIRST, _SECOND = torch.triu_indices(4, 4)
# Which monomial the product of three of the four coefficients (x, y, z, 1) is, (64, 20).
_PRODUCTS = [MONOMIALS.index(tuple(map(factors.count, range(3)))) for factors in product(range(4), repeat=3)]
_TABLE = torch.eye(20, dtype=torch.float64)[_PRODUCTS]
_PAIRS = _TABLE.view(16, 4, 20)[4 * _FIRST + _SECOND].flatten(0, 1)  # of products of two coefficients, each once
_TIMES_X = [MONOMIALS.index((a + 1, b, c)) for a, b, c in MONOMIALS[10:]]  # each of the others times x
_SOLUTION = [MONOMIALS.index(m) - 10 for m in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))]


@torch.no_grad()
def essential_in_span(basis: Tensor) -> tuple[Tensor, Tensor]:
    """Return the essential matrices in the span of four matrices (B, 4, 3, 3), and which of them are real.

    They are (B, 10, 3, 3) of unit Frobenius norm; those that are not real are some finite matrices. The last matrix of
    the basis should be the most likely: solutions without a share of it are not found. No gradient.
    """
    rows = _constraints(basis)
    reduced = -torch.linalg.solve_ex(rows[..., :10], rows[..., 10:])[0]
    reduced = torch.where(reduced.isfinite().flatten(1).all(1)[:, None, None], reduced, 0.0)
    known = torch.eye(10, dtype=basis.dtype, device=basis.device).expand(basis.shape[0], -1, -1)
    action = torch.cat([reduced, known], 1)[:, _TIMES_X]
    values, vectors = (value.to(basis.device) for value in torch.linalg.eig(action.cpu()))  # on a GPU one after another
    solutions = vectors.mT[..., _SOLUTION]
    solutions = solutions / torch.where(solutions[..., 3:] == 0, 1.0, solutions[..., 3:])
    real = (values.imag.abs() <= MAX_IMAGINARY * (1 + values.abs())) & (vectors[:, _SOLUTION[3]].abs() > 0)
    E_mat = torch.einsum("bsk,bkij->bsij", solutions.real, basis)
    norm = torch.linalg.matrix_norm(E_mat, keepdim=True)
    return E_mat / torch.where(norm > 0, norm, 1.0), real


def _constraints(basis: Tensor) -> Tensor:
    """Return the coefficients of ten cubic polynomials in the monomials, (B, 10, 20)."""
    products = basis[:, _FIRST] @ basis[:, _SECOND].mT  # E_i E_j^T
    products = products + (_FIRST != _SECOND)[:, None, None].to(basis) * products.mT
    half_trace = products.diagonal(dim1=2, dim2=3).sum(2)[..., None, None] / 2
    products = products - half_trace * torch.eye(3, dtype=basis.dtype, device=basis.device)
    cubic = products.flatten(1, 2) @ basis.transpose(1, 2).flatten(2)  # (B, 10 3, 4 3)
    cubic = cubic.view(-1, 10, 3, 4, 3).permute(0, 2, 4, 1, 3).flatten(3).flatten(1, 2) @ _PAIRS.to(basis)
    first, second, third = basis.unbind(2)
    crossed = torch.linalg.cross(second[:, :, None], third[:, None]).flatten(1, 2)
    determinant = (first @ crossed.mT).flatten(1) @ _TABLE.to(basis)
    return torch.cat([cubic, determinant[:, None]], 1)
