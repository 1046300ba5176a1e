r"""Normalisers: modules that choose the coordinates in which the fundamental matrix is solved and projected.

The one contract of this package is ``(points1, points2, weights=None) -> (T1, T2)``: pixels :math:`(B, N, 2)` of both
views and optional weights :math:`(B, N)` go in, two affine transforms :math:`(B, 3, 3)` come out. Anything that keeps
it can be given to :func:`kornia_learnnorm.find_fundamental`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from kornia_learnnorm.geometry.checks import solve_dtype, weighted_mean
from kornia_learnnorm.geometry.transforms import affine_transform, inverse_sqrt

__all__ = ["Hartley", "Identity", "PerView", "Whitening"]


class Identity(nn.Module):
    """No normalisation: both transforms are the identity (the original eight-point algorithm, in pixels).

    Example:
        >>> T1, T2 = Identity()(torch.rand(2, 8, 2), torch.rand(2, 8, 2))
        >>> T1[0]
        tensor([[1., 0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]])

    """

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return identities with shape :math:`(B, 3, 3)`."""
        eye = torch.eye(3, dtype=points1.dtype, device=points1.device).expand(points1.shape[0], 3, 3)
        return eye, eye


class PerView(nn.Module):
    """Adapt a per-view callable, such as ``kornia.geometry.epipolar.normalize_points``, to the contract.

    Args:
        normalize: maps points :math:`(B, N, 2)` (and ``weights=``, where weights are given) to a pair whose second
            element is the transform :math:`(B, 3, 3)`.

    Example:
        >>> from kornia.geometry.epipolar import normalize_points
        >>> T1, T2 = PerView(normalize_points)(torch.rand(2, 8, 2), torch.rand(2, 8, 2))
        >>> T1.shape
        torch.Size([2, 3, 3])

    """

    def __init__(self, normalize: Callable[..., tuple[Tensor, Tensor]]) -> None:
        super().__init__()
        self.normalize = normalize

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the callable's transforms of both views."""
        kwargs = {} if weights is None else {"weights": weights}
        return self.normalize(points1, **kwargs)[1], self.normalize(points2, **kwargs)[1]


class Hartley(nn.Module):
    r"""Hartley's normalisation: centroid to the origin, mean distance from it :math:`\sqrt 2` (Fan et al., Eq. 4).

    Coincident points keep their scale.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]]])
        >>> Hartley()(points, points)[0]
        tensor([[[ 0.5000,  0.0000, -1.0000],
                 [ 0.0000,  0.5000, -1.0000],
                 [ 0.0000,  0.0000,  1.0000]]])

    """

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        return self._transform(points1, weights), self._transform(points2, weights)

    @staticmethod
    def _transform(points: Tensor, weights: Tensor | None) -> Tensor:
        origin = weighted_mean(points, weights)
        radius = weighted_mean((points - origin[:, None]).norm(dim=-1, keepdim=True), weights)[..., 0]
        scale = math.sqrt(2) / torch.where(radius > _rounding(origin), radius, math.sqrt(2))
        return affine_transform(scale[:, None, None] * torch.eye(2).to(points), origin)


class Whitening(nn.Module):
    r"""Symmetric (ZCA) whitening: centroid to the origin, covariance of each view to the identity.

    :math:`T = [\Sigma^{-1/2}, -\Sigma^{-1/2} o; 0, 1]`, in closed form. Where the points are nearly collinear, the
    smaller eigenvalue of :math:`\Sigma` is floored.

    Args:
        floor: smallest ratio of the eigenvalues of :math:`\Sigma`.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [0.0, 2.0], [4.0, 2.0]]])
        >>> Whitening()(points, points)[0][0].diagonal()
        tensor([0.5000, 1.0000, 1.0000])

    """

    def __init__(self, floor: float = 1e-6) -> None:
        super().__init__()
        self.floor = floor

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        return self._transform(points1, weights), self._transform(points2, weights)

    def _transform(self, points: Tensor, weights: Tensor | None) -> Tensor:
        dtype = solve_dtype(points.device)
        x, w = points.to(dtype), None if weights is None else weights.to(dtype)
        origin = weighted_mean(x, w)
        centred = x - origin[:, None]
        covariance = torch.unflatten(
            weighted_mean((centred[..., :, None] * centred[..., None, :]).flatten(-2), w), -1, (2, 2)
        )
        spread = covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
        covariance = torch.where((spread > _rounding(origin))[:, None, None], covariance, 0.0)
        return affine_transform(inverse_sqrt(covariance, self.floor), origin).to(points.dtype)


def _rounding(origin: Tensor) -> Tensor:
    """Spread ``(B,)`` about ``origin`` up to which points coincide: a mean is not exact."""
    size: Tensor = torch.linalg.vector_norm(origin.detach(), dim=-1)
    return 16 * torch.finfo(origin.dtype).eps * size
