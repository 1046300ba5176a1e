r"""The manifold of matrices of rank 2 and unit norm: its points, steps on it, and its tangents.

A matrix is kept as :math:`F = U_{:,1:2}\, A\, V_{:,1:2}^\top` with rotations :math:`U, V` and a :math:`2 \times 2`
matrix :math:`A` of unit norm. A step has seven parameters: two tilt the last axis of each rotation, the epipole, and
three turn :math:`A` on the unit sphere. Two rotations and the ratio of the singular values are seven parameters too,
but are singular where the singular values are equal, as under pure forward motion.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

__all__ = ["Rank2", "decompose", "retract", "tangents"]


class Rank2(NamedTuple):
    """Matrices of rank 2 and unit norm.

    Attributes:
        axes: rotations of view 2 and of view 1, (B, 2, 3, 3).
        A: unit matrices between them, (B, 2, 2).
    """

    axes: Tensor
    A: Tensor

    def matrix(self) -> Tensor:
        """Return the matrices themselves, (B, 3, 3)."""
        return self.axes[:, 0, :, :2] @ self.A @ self.axes[:, 1, :, :2].mT


def decompose(F_mat: Tensor) -> Rank2:
    """Return the nearest matrices of rank 2, scaled to unit norm, to matrices (B, 3, 3).

    Example:
        >>> decompose(torch.diag(torch.tensor([4.0, 3.0, 1.0]))[None]).A
        tensor([[[0.8000, 0.0000],
                 [0.0000, 0.6000]]])

    """
    U, s, Vh = torch.linalg.svd(F_mat)
    return Rank2(torch.stack([U, Vh.mT], 1), torch.diag_embed(normalize(s[:, :2], dim=-1)))


def retract(state: Rank2, step: Tensor) -> Rank2:
    """Return the state after a step (B, 7): tilts of view 2 and of view 1, and a turn of the matrix between them."""
    a, tilt, turn = state.A.flatten(1), torch.unflatten(step[:, :4], -1, (2, 2)), step[:, None, 4:]
    turned = a + (turn @ torch.unflatten(a @ _TURNS.to(a), -1, (3, 4))).squeeze(1)
    # Cayley's map agrees with the exponential to second order and has no sine.
    S = torch.unflatten(tilt @ _SKEW.to(a), -1, (3, 3))
    square = S @ S
    rotation = (S + square / 2) / (1 - square[..., 2:, 2:] / 4)
    return Rank2(state.axes + state.axes @ rotation, torch.unflatten(normalize(turned, dim=-1), -1, (2, 2)))


def tangents(state: Rank2) -> Tensor:
    """Return the derivatives (B, 9, 7) of the matrices' column-major entries by a step."""
    U, V = state.axes.unbind(1)
    inner = torch.unflatten(state.A.flatten(1) @ _TANGENTS.to(U), -1, (3, 21))
    outer = V @ torch.unflatten(U @ inner, -1, (3, 7)).transpose(1, 2).flatten(2)
    return torch.unflatten(outer, -1, (3, 7)).flatten(1, 2)


def _turns(a: Tensor) -> Tensor:
    """Return orthonormal directions (*, 3, 4) orthogonal to unit quaternions (*, 4): i, j and k times them."""
    a, b, c, d = a.unbind(-1)
    return torch.unflatten(torch.stack([-b, a, -d, c, -c, d, a, -b, -d, -c, b, a], -1), -1, (3, 4))


def _axis_tangents(a: Tensor) -> Tensor:
    """Return derivatives (*, 3, 3, 7) of U^T F V by a step; A is (*, 4)."""
    A, derivatives = torch.unflatten(a, -1, (2, 2)), a.new_zeros(*a.shape[:-1], 3, 3, 7)
    derivatives[..., 2, :2, :2] = A.mT
    derivatives[..., :2, 2, 2:4] = A
    derivatives[..., :2, :2, 4:] = torch.unflatten(_turns(a).mT, -2, (2, 2))
    return derivatives


# All three functions are linear: one product with their values at the unit vectors computes them.
_TURNS = _turns(torch.eye(4, dtype=torch.float64)).flatten(1)
_TANGENTS = _axis_tangents(torch.eye(4, dtype=torch.float64)).flatten(1)
_SKEW = torch.tensor([[0, 0, -1, 0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, -1, 0, 1, 0]], dtype=torch.float64)
