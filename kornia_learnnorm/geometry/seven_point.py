"""The matrices of rank 2 in a span of two, as of seven correspondences (Hartley and Zisserman, section 11.1.2)."""

import torch
from torch import Tensor

MAX_IMAGINARY = 1e-6  # relative imaginary part of a real solution
MIN_LEADING = 1e-12  # of the cubic's largest coefficient, at which its leading one is held


@torch.no_grad()
def fundamental_in_span(basis: Tensor) -> tuple[Tensor, Tensor]:
    """Return the singular matrices in the span of two matrices (B, 2, 3, 3), and which of them are real.

    They are (B, 3, 3, 3) of unit Frobenius norm, the roots of a cubic; those that are not real are some finite
    matrices. No gradient.
    """
    first, second = basis.unbind(1)
    values = torch.linalg.det(first[:, None] + _X.to(basis)[:, None, None] * second[:, None])
    coefficients = values @ _INTERPOLATION.to(basis)
    least = MIN_LEADING * coefficients.abs().amax(1, keepdim=True) + torch.finfo(basis.dtype).tiny
    leading = torch.where(coefficients[:, 3:].abs() < least, least, coefficients[:, 3:])
    shift = torch.eye(3, dtype=basis.dtype, device=basis.device)[:, 1:].expand(basis.shape[0], 3, 2)
    roots = torch.linalg.eigvals(torch.cat([shift, -(coefficients[:, :3] / leading)[..., None]], 2))
    real = roots.imag.abs() <= MAX_IMAGINARY * (1 + roots.abs())
    M = first[:, None] + roots.real[..., None, None] * second[:, None]
    return M / torch.linalg.matrix_norm(M, keepdim=True), real


_X = torch.tensor([-1.0, 0.0, 1.0, 2.0], dtype=torch.float64)
# From det(first + x second) at these x to the coefficients.
_INTERPOLATION = torch.linalg.inv(torch.stack([_X**k for k in range(4)])).contiguous()
