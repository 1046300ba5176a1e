r"""The manifolds of fundamental and of essential matrices of unit norm: their points, steps on them, and tangents.

A matrix is kept as :math:`F = U_{:,1:2}\, A\, V_{:,1:2}^\top` with rotations :math:`U, V` and a :math:`2 \times 2`
matrix :math:`A` of unit norm. A step has seven parameters: two tilt the last axis of each rotation, the epipole, and
three turn :math:`A` on the unit sphere. Two rotations and the ratio of the singular values are seven parameters too,
but are singular where the singular values are equal, as under pure forward motion.

An essential matrix has equal singular values: :math:`A` is a rotation over :math:`\sqrt 2`. Of the three turns, the
first alone keeps it one, so that a step has the five parameters of a relative pose.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import normalize

__all__ = ["Calibrated", "Rank2", "decompose", "decompose_essential", "nearest_essential", "retract", "tangents"]


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

    def tangents(self) -> Tensor:
        """Return the derivatives (B, 9, 7) of the matrices' column-major entries by a step."""
        return tangents(self)


class Calibrated(NamedTuple):
    r"""Fundamental matrices :math:`F = C_2^\top E C_1` of essential matrices :math:`E` of unit norm.

    Attributes:
        axes: rotations of view 2 and of view 1, (B, 2, 3, 3).
        A: rotations of the plane over the root of two, (B, 2, 2).
        C1: from the coordinates of view 1 to directions in the camera, such as :math:`K_1^{-1}`, (B, 3, 3).
        C2: from the coordinates of view 2 to directions in the camera, (B, 3, 3).
    """

    axes: Tensor
    A: Tensor
    C1: Tensor
    C2: Tensor

    def essential(self) -> Tensor:
        """Return the essential matrices, (B, 3, 3)."""
        return Rank2(self.axes, self.A).matrix()

    def matrix(self) -> Tensor:
        """Return the fundamental matrices, (B, 3, 3)."""
        return self.C2.mT @ self.essential() @ self.C1

    def tangents(self) -> Tensor:
        """Return the derivatives (B, 9, 5) of the fundamental matrices' column-major entries by a step."""
        D = tangents(Rank2(self.axes, self.A))[..., :5]
        columns = self.C2.mT[:, None] @ torch.unflatten(D, 1, (3, 3))  # (B, column of E, row of F, 5)
        return (self.C1.mT @ columns.flatten(2)).view_as(D)


State = TypeVar("State", Rank2, Calibrated)


def decompose(F_mat: Tensor) -> Rank2:
    """Return the nearest matrices of rank 2, scaled to unit norm, to matrices (B, 3, 3).

    Example:
        >>> decompose(torch.diag(torch.tensor([4.0, 3.0, 1.0]))[None]).A
        tensor([[[0.8000, 0.0000],
                 [0.0000, 0.6000]]])

    """
    U, s, Vh = torch.linalg.svd(F_mat)
    return Rank2(torch.stack([U, Vh.mT], 1), torch.diag_embed(normalize(s[:, :2], dim=-1)))


def decompose_essential(E_mat: Tensor, C1: Tensor, C2: Tensor) -> Calibrated:
    r"""Return the fundamental matrices :math:`C_2^\top E C_1` of the nearest essential matrices of unit norm.

    Args:
        E_mat: matrices with shape :math:`(B, 3, 3)`, any scale but zero.
        C1: from the coordinates of view 1 to directions in the camera, with shape :math:`(B, 3, 3)`.
        C2: from the coordinates of view 2 to directions in the camera, with shape :math:`(B, 3, 3)`.

    Example:
        >>> eye = torch.eye(3)[None]
        >>> decompose_essential(torch.diag(torch.tensor([4.0, 3.0, 1.0]))[None], eye, eye).essential()
        tensor([[[0.7071, 0.0000, 0.0000],
                 [0.0000, 0.7071, 0.0000],
                 [0.0000, 0.0000, 0.0000]]])

    """
    axes, A = decompose(E_mat)
    return Calibrated(axes, torch.eye(2).to(A).expand_as(A) * 0.5**0.5, C1, C2)


def nearest_essential(E_mat: Tensor) -> Tensor:
    """Return the nearest essential matrices, scaled to unit norm, to matrices (B, 3, 3).

    Example:
        >>> nearest_essential(torch.diag(torch.tensor([4.0, 3.0, 1.0]))[None]).diagonal(dim1=1, dim2=2)
        tensor([[0.7071, 0.7071, 0.0000]])

    """
    axes, A = decompose(E_mat)
    return Rank2(axes, torch.eye(2).to(A).expand_as(A) * 0.5**0.5).matrix()


def retract(state: State, step: Tensor) -> State:
    """Return the state after a step, (B, 7) or (B, 5): tilts of both views and turns of the matrix between them."""
    a, tilt, turn = state.A.flatten(1), torch.unflatten(step[:, :4], -1, (2, 2)), step[:, None, 4:]
    turns = torch.unflatten(a @ _TURNS.to(a), -1, (3, 4))[:, : turn.shape[-1]]
    turned = a + (turn @ turns).squeeze(1)
    # Cayley's map agrees with the exponential to second order and has no sine.
    S = torch.unflatten(tilt @ _SKEW.to(a), -1, (3, 3))
    square = S @ S
    rotation = (S + square / 2) / (1 - square[..., 2:, 2:] / 4)
    axes, A = state.axes + state.axes @ rotation, torch.unflatten(normalize(turned, dim=-1), -1, (2, 2))
    return state._replace(axes=axes, A=A)


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
