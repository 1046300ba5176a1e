"""Hartley's normalisation."""

from __future__ import annotations

from torch import Tensor

from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.normalizers.normalizer import ProblemNormalizer

__all__ = ["Hartley"]


class Hartley(ProblemNormalizer):
    r"""Hartley's normalisation: centroid to the origin, mean distance from it :math:`\sqrt 2` (Fan et al., Eq. 4).

    Coincident points keep their scale.

    Example:
        >>> import torch
        >>> points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]]])
        >>> Hartley()(points, points)[0]
        tensor([[[ 0.5000,  0.0000, -1.0000],
                 [ 0.0000,  0.5000, -1.0000],
                 [ 0.0000,  0.0000,  1.0000]]])

    """

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views."""
        return problem.T1, problem.T2
