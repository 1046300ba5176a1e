r"""Estimators: modules from correspondences to a fundamental matrix."""

from __future__ import annotations

from typing import Literal

from torch import Tensor, nn

from kornia_learnnorm.normalizers import Hartley
from kornia_learnnorm.solver import Normalizer, find_fundamental

__all__ = ["EightPoint"]


class EightPoint(nn.Module):
    r"""The normalised eight-point algorithm as a layer.

    Args:
        normalizer: a module or callable ``(points1, points2, weights) -> (T1, T2)``; Hartley's when not given.
        rank2: how the singularity constraint is enforced: ``None`` projects in normalised coordinates, ``"optimal"``
            corrects in pixels with the covariance of :math:`F`.

    Example:
        >>> import torch
        >>> layer = EightPoint()
        >>> layer(torch.rand(2, 8, 2), torch.rand(2, 8, 2)).shape
        torch.Size([2, 3, 3])

    """

    def __init__(self, normalizer: Normalizer | None = None, rank2: Literal["optimal"] | None = None) -> None:
        super().__init__()
        self.normalizer = Hartley() if normalizer is None else normalizer
        self.rank2 = rank2

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> Tensor:
        r"""Return fundamental matrices :math:`(B, 3, 3)`; see :func:`kornia_learnnorm.find_fundamental`.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`.

        """
        return find_fundamental(points1, points2, weights, self.normalizer, self.rank2)
