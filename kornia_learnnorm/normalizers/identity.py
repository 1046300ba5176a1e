"""No normalisation: the original eight-point algorithm, in pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.normalizers.normalizer import ProblemNormalizer

__all__ = ["Identity"]


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
