r"""Closed forms: no normalisation, Hartley's, and whitening."""

import torch
from torch import Tensor

from kornia_learnnorm.geometry.checks import weighted_mean
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import whitening_from_moments
from kornia_learnnorm.normalizers.normalizer import ProblemNormalizer

__all__ = ["Hartley", "Identity", "Whitening"]


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
        eye = torch.eye(3, dtype=problem.x1.dtype, device=problem.x1.device).expand(problem.x1.shape[0], 3, 3)
        return eye, eye


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
        floor: smallest ratio of the eigenvalues of :math:`\Sigma`; ValueError unless positive.

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
        rows = torch.stack([problem.points1, problem.points2]).mT.contiguous()
        origin = weighted_mean(rows.mT, problem.weights)
        x, y = (rows - origin[..., None]).unbind(-2)
        a, b, c = weighted_mean(torch.stack([x * x, x * y, y * y], -2).mT, problem.weights).unbind(-1)
        covariance = torch.unflatten(torch.stack([a, b, b, c], -1), -1, (2, 2))
        T1, T2 = whitening_from_moments(origin, covariance, self.floor)
        return T1, T2

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"floor={self.floor:g}"
