"""The cost of a refinement: robust losses of distances in pixels, and the distances' derivatives by the matrices."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_learnnorm.estimators.robust_losses import Loss
from kornia_learnnorm.geometry.distances import DistanceScale

__all__ = ["EpipolarCost"]


class EpipolarCost(NamedTuple):
    """Sum of losses over the correspondences of each matrix, or over one set that all matrices share.

    Attributes:
        x1: homogeneous points of view 1, the first two coordinates in pixels, (B or 1, 3, N).
        x2: homogeneous points of view 2, (B or 1, 3, N).
        weights: weights of the losses, (B or 1, N).
        scale: from algebraic residuals to distances, see :mod:`kornia_learnnorm.geometry.distances`.
        loss: robust loss of squared distances.
    """

    x1: Tensor
    x2: Tensor
    weights: Tensor
    scale: DistanceScale
    loss: Loss

    def select(self, rows: Tensor) -> EpipolarCost:
        """Return the cost of some of the matrices."""
        if len(self.x1) == 1:
            return self
        return EpipolarCost(self.x1[rows], self.x2[rows], self.weights[rows], self.scale, self.loss)

    def rounding(self) -> Tensor:
        """Return the weighted sum of squares that rounding alone can cause, (B or 1,)."""
        distance = 4 * torch.finfo(self.x1.dtype).eps * (self.x1[:, 2, 0] + self.x2[:, 2, 0])
        return distance.square() * self.weights.sum(-1)

    def distances(self, F: Tensor) -> Tensor:
        """Return the distances, with signs, of matrices (B, 3, 3), (B, N)."""
        return self._expand(F)[0]

    def linearise(self, F: Tensor) -> Tensor:
        """Return derivatives by the entries, column-major, and in the last row the distances themselves, (B, 10, N)."""
        distance, scale, pull1, pull2 = self._expand(F)
        J = F.new_empty(len(F), 10, distance.shape[-1])
        J[:, 9] = distance
        # A change dF changes the distance by (scale x2 + pull2)^T dF x1 + x2^T dF pull1.
        left = scale[:, None] * self.x2
        left[:, :2] += pull2
        entries = torch.unflatten(J[:, :9], 1, (3, 3))
        torch.mul(self.x1[:, :, None], left[:, None], out=entries)
        entries[:, :2].addcmul_(pull1[:, :, None], self.x2[:, None])
        return J

    def _expand(self, F: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return distances and scales, (B, N), and derivatives by the lines' normals of both views, (B, 2, N)."""
        line1, line2 = F.mT[:, :2] @ self.x2, F @ self.x1
        algebraic = (self.x2 * line2).sum(1)
        line2 = line2[:, :2]
        floor = torch.finfo(F.dtype).eps ** 2  # below it the direction of a line is rounding
        sq_norm1, sq_norm2 = (line.square().sum(1).clamp(min=floor) for line in (line1, line2))
        scale, slope1, slope2 = self.scale(sq_norm1, sq_norm2)
        twice = 2 * algebraic
        return algebraic * scale, scale, (twice * slope1)[:, None] * line1, (twice * slope2)[:, None] * line2
