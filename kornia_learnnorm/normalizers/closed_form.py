r"""Normalisers in closed form: none, Hartley's, whitening, and an adapter for per-view callables."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import whitening_transform
from kornia_learnnorm.normalizers.contract import ProblemNormalizer

__all__ = ["Hartley", "Identity", "PerView", "Whitening"]


class Identity(ProblemNormalizer):
    """No normalisation: both transforms are the identity (the original eight-point algorithm, in pixels).

    Example:
        >>> T1, T2 = Identity()(torch.rand(2, 8, 2), torch.rand(2, 8, 2))
        >>> T1[0]
        tensor([[1., 0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]])

    """

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return identities with shape :math:`(B, 3, 3)`."""
        eye = torch.eye(3, dtype=problem.x1.dtype, device=problem.x1.device).expand(len(problem.x1), 3, 3)
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
        r"""Return the callable's transforms of both views.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, handed on unchecked.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional weights with shape :math:`(B, N)`.

        Returns:
            two transforms with shape :math:`(B, 3, 3)`.

        """
        kwargs = {} if weights is None else {"weights": weights}
        return self.normalize(points1, **kwargs)[1], self.normalize(points2, **kwargs)[1]


class Hartley(ProblemNormalizer):
    r"""Hartley's normalisation: centroid to the origin, mean distance from it :math:`\sqrt 2` (Fan et al., Eq. 4).

    Coincident points keep their scale.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]]])
        >>> Hartley()(points, points)[0]
        tensor([[[ 0.5000,  0.0000, -1.0000],
                 [ 0.0000,  0.5000, -1.0000],
                 [ 0.0000,  0.0000,  1.0000]]])

    """

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        return problem.T1, problem.T2


class Whitening(ProblemNormalizer):
    r"""Symmetric (ZCA) whitening: centroid to the origin, covariance of each view to the identity.

    :math:`T = [\Sigma^{-1/2}, -\Sigma^{-1/2} o; 0, 1]`, in closed form. Where the points are nearly collinear, the
    smaller eigenvalue of :math:`\Sigma` is floored.

    Args:
        floor: smallest ratio of the eigenvalues of :math:`\Sigma`.

    Raises:
        ValueError: if the floor is not positive.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [0.0, 2.0], [4.0, 2.0]]])
        >>> Whitening()(points, points)[0][0].diagonal()
        tensor([0.5000, 1.0000, 1.0000])

    """

    def __init__(self, floor: float = 1e-6) -> None:
        super().__init__()
        if not floor > 0:
            raise ValueError(f"floor must be positive, got {floor}")
        self.floor = floor

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        return (
            whitening_transform(problem.points1, problem.weights, self.floor),
            whitening_transform(problem.points2, problem.weights, self.floor),
        )

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"floor={self.floor:g}"
