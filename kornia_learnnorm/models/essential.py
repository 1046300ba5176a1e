r"""The essential matrix as a two-view model: two equal singular values, five degrees of freedom.

It is a fundamental matrix :math:`F = C_2^\top E C_1` of known cameras: distances are those in pixels. On the manifold
of :class:`~kornia_learnnorm.models.fundamental.Rank2` the matrix :math:`A` of :math:`E` is a rotation over
:math:`\sqrt 2`. Of the three turns in a step, only the first keeps :math:`A` of this form, so a step has the five
parameters of a relative pose.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kornia_learnnorm.geometry.constrained_fit import Fit, Loss
from kornia_learnnorm.geometry.distances import Distance
from kornia_learnnorm.geometry.dlt import design_matrix
from kornia_learnnorm.geometry.five_point import essential_in_span
from kornia_learnnorm.models.fundamental import Fundamental, Rank2

MIN_PIVOT = 1e-12  # of the largest one, of a sample of five correspondences that determine finitely many matrices


class Essential(Fundamental):
    r"""Fundamental matrices :math:`F = C_2^\top E C_1` of essential matrices.

    ``C1`` and ``C2``, :math:`(B, 3, 3)` or :math:`(1, 3, 3)`, go from the coordinates of a view to directions in its
    camera, as :math:`K^{-1}` does. ``distance`` is ``"sampson"`` or ``"symmetric"``, in the coordinates.
    """

    name = "essential"
    dof = 5
    sample_size = 5
    confidence = 0.999  # known cameras reduce the effect of noise on a sample

    def __init__(self, C1: Tensor, C2: Tensor, distance: Distance = "sampson") -> None:
        super().__init__(distance=distance)
        # Of unit norm, so that the fundamental matrices have a norm of about one too.
        self.C1, self.C2 = (torch.div(C, torch.linalg.matrix_norm(C, keepdim=True)) for C in (C1, C2))

    @classmethod
    def of_cameras(cls, K1: Tensor, K2: Tensor, T1: Tensor, T2: Tensor, distance: Distance = "sampson") -> Self:
        """Return the model of pixels after transforms, of cameras and transforms that broadcast to (B, 3, 3)."""
        return cls(torch.linalg.inv_ex(T1 @ K1)[0], torch.linalg.inv_ex(T2 @ K2)[0], distance)

    def constrain(self, M: Tensor) -> Tensor:
        """Return the matrices of the nearest essential matrices."""
        return self.state(M).matrix()

    def state(self, M: Tensor) -> "Calibrated":
        """Return the nearest essential matrices of unit norm."""
        inverse1, inverse2 = (torch.linalg.inv_ex(C)[0] for C in (self.C1, self.C2))
        return self.calibrated(inverse2.mT @ M @ inverse1)

    def calibrated(self, E_mat: Tensor) -> "Calibrated":
        """Return the nearest essential matrices of unit norm to matrices of directions (B, 3, 3)."""
        axes, A = Fundamental().state(E_mat)
        equal = torch.eye(2).to(A).expand_as(A) * 0.5**0.5
        return Calibrated(axes, equal, self.C1.expand_as(E_mat), self.C2.expand_as(E_mat))

    def attach(self, state: "Calibrated") -> "Calibrated":
        """Return states with the model's cameras, and so their derivatives."""
        return state._replace(C1=self.C1.expand_as(state.C1), C2=self.C2.expand_as(state.C2))

    def solve_samples(self, x1: Tensor, x2: Tensor, shift: float) -> Tensor:
        """Return the matrices of samples of five, up to ten each; degenerate ones have none, but coplanar ones have."""
        Q, R = torch.linalg.qr(design_matrix(x1 @ self.C1.mT, x2 @ self.C2.mT).mT, mode="complete")
        E_mat, real = essential_in_span(torch.unflatten(Q[..., 5:].mT, -1, (3, 3)))
        pivots = R.diagonal(dim1=-2, dim2=-1).abs()
        E_mat = E_mat[real & (pivots.amin(-1) > MIN_PIVOT * pivots.amax(-1))[:, None]]
        return self.C2.mT @ E_mat @ self.C1

    def reweighted_fit(self, x1: Tensor, x2: Tensor, M: Tensor, losses: Sequence[Loss]) -> Fit | None:
        """Return None: essential matrices have no such fit, and are optimised on their manifold."""
        return None


class Calibrated(NamedTuple):
    r"""Fundamental matrices :math:`F = C_2^\top E C_1` of essential matrices :math:`E` of unit norm."""

    axes: Tensor  # rotations of view 2 and of view 1, (B, 2, 3, 3)
    A: Tensor  # rotations of the plane over the root of two, (B, 2, 2)
    C1: Tensor  # from the coordinates of view 1 to directions in the camera, (B, 3, 3)
    C2: Tensor

    def essential(self) -> Tensor:
        """Return the essential matrices, (B, 3, 3)."""
        return Rank2(self.axes, self.A).matrix()

    def matrix(self) -> Tensor:
        """Return the fundamental matrices, (B, 3, 3)."""
        return self.C2.mT @ self.essential() @ self.C1

    def rotations(self) -> Tensor:
        """Return the two rotations (B, 2, 3, 3) of each essential matrix; translations are along view 2's last axis.

        No SVD is computed: two equal singular values would make its derivatives infinite.
        """
        U, V = self.axes.unbind(1)
        turn = self.A.new_tensor([[0.0, 1.0], [-1.0, 0.0]]) @ self.A * 2**0.5
        turned, last = U[..., :2] @ turn @ V[..., :2].mT, U[..., 2:] @ V[..., 2:].mT
        last = (torch.linalg.det(U) * torch.linalg.det(V)).sign().detach()[:, None, None] * last
        return torch.stack([last + turned, last - turned], 1)

    def poses(self) -> tuple[Tensor, Tensor]:
        """Return the four rotations (B, 4, 3, 3) and unit translations (B, 4, 3) of the essential matrices."""
        t = self.axes[:, 0, :, 2]
        return self.rotations().repeat_interleave(2, 1), torch.stack([t, -t, t, -t], 1)

    def tangents(self) -> Tensor:
        """Return the derivatives (B, 9, 5) of the fundamental matrices' column-major entries by a step."""
        D = Rank2(self.axes, self.A).tangents()[..., :5]
        columns = self.C2.mT[:, None] @ torch.unflatten(D, 1, (3, 3))  # (B, column of E, row of F, 5)
        return (self.C1.mT @ columns.flatten(2)).view_as(D)

    def retract(self, step: Tensor) -> Self:
        """Return the state after a step, (B, 5)."""
        return type(self)(*Rank2(self.axes, self.A).retract(step), self.C1, self.C2)


def nearest_essential(E_mat: Tensor) -> Tensor:
    """Return the nearest essential matrices, scaled to unit norm, to matrices (B, 3, 3)."""
    eye = torch.eye(3).to(E_mat)[None]
    return Essential(eye, eye).calibrated(E_mat).essential()
