r"""Second moments of the rows of the design matrix under many weights, and the normal equations of steps on them."""

import torch
from torch import Tensor

DAMPING = 1e-9  # of the mean diagonal of the normal matrix, added to it


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
