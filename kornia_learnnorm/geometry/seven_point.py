"""The matrices of rank 2 in a span of two, as of seven correspondences (Hartley and Zisserman, section 11.1.2)."""

import torch
from torch import Tensor

from kornia_learnnorm.geometry.matrices import determinant

_ANGLES = torch.arange(4, dtype=torch.float64) * torch.pi / 4
_TURNS = 2 * torch.pi / 3 * torch.arange(3, dtype=torch.float64)
_ROTATIONS = torch.stack([-_ANGLES.sin(), _ANGLES.cos(), _ANGLES.cos(), _ANGLES.sin()], 1).view(4, 2, 2)
# From the values of a cubic form at these angles to its coefficients by powers of the cotangent.
_FORM = torch.stack([_ANGLES.cos() ** k * _ANGLES.sin() ** (3 - k) for k in range(4)])
_COEFFICIENTS = torch.linalg.inv(_FORM).contiguous()


@torch.no_grad()
def fundamental_in_span(basis: Tensor) -> tuple[Tensor, Tensor]:
    """Return the singular matrices in the span of two matrices (B, 2, 3, 3), and which of them are real.

    They are (B, 3, 3, 3) of unit Frobenius norm, the roots of a cubic; those that are not real are some finite
    matrices. No gradient.
    """
    flat, rotations = basis.flatten(2), _ROTATIONS.to(basis)
    values = determinant(torch.unflatten(rotations[:, 1] @ flat, 2, (3, 3)))  # at four angles
    # The angle of the largest determinant gives the matrix of the leading coefficient.
    angle = values.abs().argmax(1)
    turned = torch.cat([values, -values], 1).gather(1, angle[:, None] + torch.arange(4, device=basis.device))
    leading = turned[:, :1]
    monic = turned @ _COEFFICIENTS.to(basis)[:, :3] / torch.where(leading == 0, torch.inf, leading)
    roots, real = _roots(*monic.unbind(1))
    first, second = (rotations[angle] @ flat).unbind(1)
    M = first[:, None] + roots[..., None] * second[:, None]
    M = M / torch.linalg.vector_norm(M, dim=2, keepdim=True)
    return torch.unflatten(M, 2, (3, 3)), real


def _roots(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Return the roots (B, 3) of cubics x^3 + c x^2 + b x + a by Cardano and Viete, and which of them are real.

    Kornia's ``solve_cubic`` gives zeros in the place of those that are not.
    """
    middle = c / 3
    p, q = b / 3 - middle.square(), middle**3 + (a - middle * b) / 2  # y^3 + 3 p y + 2 q, x = y - middle
    discriminant = p**3 + q.square()
    alone = discriminant > 0
    root = discriminant.abs().sqrt()
    u = -torch.copysign((q.abs() + root) ** (1 / 3), q)
    single = u - p / torch.where(u == 0, torch.inf, u)
    three = 2 * (-p).clamp(min=0).sqrt()[:, None] * torch.cos((torch.atan2(root, -q) / 3)[:, None] + _TURNS.to(p))
    x = torch.where(alone[:, None], single[:, None], three) - middle[:, None]
    a, b, c = a[:, None], b[:, None], c[:, None]
    slope = (3 * x + 2 * c) * x + b
    x = x - (((x + c) * x + b) * x + a) / torch.where(slope == 0, torch.inf, slope)
    return x, torch.stack([torch.ones_like(alone), ~alone, ~alone], 1)
