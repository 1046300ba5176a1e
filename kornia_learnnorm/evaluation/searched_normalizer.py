r"""The per-sample optimum of the normalisation: how small a normaliser can make the residual of a sample."""

import torch
from torch import Tensor, nn

from kornia_learnnorm import ReweightedWhitening, symmetric_epipolar_distance
from kornia_learnnorm.estimators.linear import solve_in_coordinates
from kornia_learnnorm.geometry.checks import weighted_mean
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import spd_transform
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.normalizers.normalizer import Normalizer, ProblemNormalizer, transforms_of

NUM_PARAMETERS = 5  # of each view, as spd_transform takes them
MAX_PARAMETER = 3.0  # beyond it rounding errors of F would pass for gains
LEARNING_RATE = 0.1  # length of the first step; it falls to zero as half a cosine


class SearchedNormalizer(ProblemNormalizer):
    r"""Search each sample's transforms by gradient descent on its own symmetric epipolar distance.

    :math:`T_i = B(p_i)\, T_i^{base}` with five parameters :math:`p_i` of
    :func:`~kornia_learnnorm.geometry.transforms.spd_transform` for every sample, from zero and within plus and minus 3.
    Adam lowers the logarithm of the mean distance (Fan et al., Eq. 8) and the best parameters of all steps are kept.

    Use it as a limit to compare with, not as a method: it fits the sample's own points, noise included, and its result
    carries no gradient. It is a local search, so the true optimum may be lower still.

    Args:
        base: normaliser to start from; :class:`~kornia_learnnorm.ReweightedWhitening` when not given.
        steps: number of steps.
    """

    min_points = 8

    def __init__(self, base: nn.Module | None = None, steps: int = 100) -> None:
        super().__init__()
        if steps < 1:
            raise ValueError(f"steps must be positive, got {steps}")
        self.base: Normalizer = ReweightedWhitening() if base is None else base
        self.steps = steps

    def transforms(self, problem: LinearProblem) -> tuple[Tensor, Tensor]:
        """Return the transforms :math:`(B, 3, 3)` of both views, without gradient."""
        with torch.inference_mode(False):  # a caller's inference mode has no gradients to offer
            weights = None if problem.weights is None else problem.weights.detach().clone()
            points1, points2 = problem.points1.detach().clone(), problem.points2.detach().clone()
            problem = LinearProblem.from_points(points1, points2, weights, Fundamental())
            with torch.no_grad():
                T1, T2 = (T.to(problem.x1) for T in transforms_of(self.base, problem))
            with torch.enable_grad():
                params1, params2 = self._search(problem, T1, T2)
        return spd_transform(params1) @ T1, spd_transform(params2) @ T2

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"steps={self.steps}"

    def _search(self, problem: LinearProblem, T1: Tensor, T2: Tensor) -> tuple[Tensor, Tensor]:
        """Return the best parameters met, ``(B, P)`` of each view."""
        x1, x2, w = problem.points1, problem.points2, problem.weights
        free = x1.new_zeros(2, len(x1), NUM_PARAMETERS, requires_grad=True)
        best, least = torch.zeros_like(free), x1.new_full((len(x1),), torch.inf)
        optimizer = torch.optim.Adam([free], lr=LEARNING_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.steps)
        for _ in range(self.steps):
            params = MAX_PARAMETER * torch.tanh(free / MAX_PARAMETER)
            F_mat = solve_in_coordinates(problem, spd_transform(params[0]) @ T1, spd_transform(params[1]) @ T2)
            distance = weighted_mean(symmetric_epipolar_distance(x1, x2, F_mat)[..., None], w)[:, 0]
            better = distance.detach() < least
            least = torch.where(better, distance.detach(), least)
            best = torch.where(better[:, None], params.detach(), best)
            # Adam works on every number by itself: the sum keeps the samples apart.
            (free.grad,) = torch.autograd.grad((distance + torch.finfo(x1.dtype).tiny).log().sum(), free)
            optimizer.step()
            schedule.step()
        return best[0], best[1]
