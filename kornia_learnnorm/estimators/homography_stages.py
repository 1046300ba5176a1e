r"""Refinement of the learned homography by reweighted least squares.

Correspondences enter a step through the :math:`9 \times 9` matrix of the second moments of their design rows alone,
which four weighted moments of view 1's points make: a step costs little for ten matches and for thousands.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_learnnorm.estimators.match_features import CommonFrame
from kornia_learnnorm.estimators.optimize import UNROLLED_LOSS
from kornia_learnnorm.estimators.stages import Refinement
from kornia_learnnorm.geometry.checks import safe_divisor
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.homography import Homography, UnitMatrix

__all__ = ["HomographyRefinement"]

EARLY_SCALE, LAST_SCALE = 3.0, 6.0  # of the robust loss, in geometric means of the inliers' distances
LAST_POWER = 0.1  # of the probabilities in the last stage: most matches are to count, and a robust loss drops outliers
SQUARE_FLOOR = 1e-10  # of the frame's unit squared, added to squared distances before their logarithm
DAMPING = 1e-12  # of the mean diagonal of the normal matrix, added to it


class HomographyRefinement(Refinement):
    r"""Reweighted least squares of a stage's homographies.

    With the scale :math:`s`, the weights of the rows are those of Geman and McClure's loss of :math:`d_i / s`, times
    the probabilities of inliers, in the last stage to the power of 0.1, times the factor from squared algebraic
    residuals to squared Sampson distances.
    """

    model: Homography

    def __init__(self, model: Homography, problem: LinearProblem, frame: CommonFrame) -> None:
        super().__init__(model, problem, frame)
        self.products = (self.x1[:, :, None] * self.x1[:, None]).flatten(1, 2)  # of the points of view 1, (B, 9, N)
        self.terms = model.sampson_terms(self.x1, self.x2)

    def optimize(self, M: Tensor, probability: Tensor, steps: int, last: bool) -> Tensor:
        """Return the matrices after so many steps."""
        share = probability if self.weights is None else probability * self.weights
        share = share / safe_divisor(share.sum(1, keepdim=True))
        number = (1 / safe_divisor(share.square().sum(1, keepdim=True))).clamp(min=self.model.dof + 1.0)
        scale, power = (LAST_SCALE, LAST_POWER) if last else (EARLY_SCALE, 1.0)
        square_scale = scale**2 * number / (number - self.model.dof)
        weights = probability.clamp(min=torch.finfo(M.dtype).tiny) ** power
        weights = weights if self.weights is None else weights * self.weights
        M = M / torch.linalg.matrix_norm(M, keepdim=True)
        for _ in range(steps):
            squares, factor = (value[:, 0] for value in self.model.sampson_squares(M[:, None], self.terms))
            mean = (share * (squares + SQUARE_FLOOR).log()).sum(1, keepdim=True).exp()
            M = self._step(M, weights * factor * UNROLLED_LOSS(squares / (square_scale * mean))[1])
        return M

    def _step(self, M: Tensor, weights: Tensor) -> Tensor:
        """Return the matrices after a step of least squares with weights (B, N) of the rows."""
        weights = weights / safe_divisor(weights.sum(1, keepdim=True))
        u, v, _ = self.x2.unbind(1)
        weighted = torch.stack([weights, -weights * u, -weights * v, weights * (u * u + v * v)], 1)
        S, Su, Sv, Suv = torch.unflatten(weighted @ self.products.mT, 2, (3, 3)).unbind(1)
        zero = torch.zeros_like(S)
        moments = torch.cat([torch.cat(row, 2) for row in ([S, zero, Su], [zero, S, Sv], [Su, Sv, Suv])], 1)
        state = UnitMatrix(M.mT)  # moments are those of row-major entries
        D, h = state.tangents(), M.flatten(1)[..., None]
        normal, eye = D.mT @ moments @ D, torch.eye(self.model.dof, dtype=M.dtype, device=M.device)
        damping = DAMPING * normal.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] + torch.finfo(M.dtype).tiny
        return state.retract(-torch.linalg.solve_ex(normal + damping * eye, D.mT @ moments @ h)[0][..., 0]).M.mT
