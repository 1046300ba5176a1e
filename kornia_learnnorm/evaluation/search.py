r"""The per-sample optimum of the normalisation: how far any normaliser could go on a sample's own points."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from kornia_learnnorm.estimators.fundamental import find_fundamental
from kornia_learnnorm.geometry.checks import check_correspondences, solve_dtype, weighted_mean
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.transforms import spd_transform
from kornia_learnnorm.normalizers.reweighted import ReweightedWhitening

__all__ = ["SearchedNormalizer"]

_BOUND = 3.0


class SearchedNormalizer(nn.Module):
    r"""Search each sample's transforms by gradient descent on its own symmetric epipolar distance.

    :math:`T_i = B(p_i)\, T_i^{base}` with parameters :math:`p_i` for every sample, which start at zero. Adam lowers the
    logarithm of the mean distance (Fan et al., Eq. 7) and the best parameters of all steps are kept, so that no sample
    ends above its base. They stay within plus and minus 3: beyond, rounding errors of :math:`F` would pass for gains.

    Use it as a limit to compare with, not as a method: it fits the sample's own points, noise included, costs a
    hundred solutions and its result carries no gradient. It is a local search, so the true optimum may be lower still.

    Args:
        base: normaliser to start from; :class:`~kornia_learnnorm.ReweightedWhitening` when not given.
        transform: builder from parameters :math:`(B, P)` to transforms :math:`(B, 3, 3)`.
        num_parameters: parameters per view :math:`P`, as the builder wants them.
        steps: steps of the search.
        learning_rate: first step length; it falls to zero as half a cosine.

    Raises:
        ValueError: if ``steps`` or ``learning_rate`` is not positive.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> T1, T2 = SearchedNormalizer(steps=5)(torch.rand(2, 8, 2), torch.rand(2, 8, 2))
        >>> T1.shape
        torch.Size([2, 3, 3])

    """

    def __init__(
        self,
        base: nn.Module | None = None,
        transform: Callable[[Tensor], Tensor] = spd_transform,
        num_parameters: int = 5,
        steps: int = 100,
        learning_rate: float = 0.1,
    ) -> None:
        super().__init__()
        if steps < 1 or learning_rate <= 0:
            raise ValueError(f"steps and learning_rate must be positive, got {steps} and {learning_rate}")
        self.base = ReweightedWhitening() if base is None else base
        self.transform = transform
        self.num_parameters = num_parameters
        self.steps = steps
        self.learning_rate = learning_rate

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        r"""Return the transforms :math:`(B, 3, 3)` of both views, without gradient.

        Args:
            points1: pixels in the first view with shape :math:`(B, N, 2)`, :math:`N \ge 8`.
            points2: pixels in the second view with shape :math:`(B, N, 2)`.
            weights: optional non-negative weights with shape :math:`(B, N)`; zero means absent.

        Raises:
            TypeError: if the points are not floating-point tensors of one dtype.
            ShapeError: if a shape is wrong.
            ValueError: if there are fewer than eight correspondences or a value is not finite.

        """
        check_correspondences(points1, points2, weights)
        dtype = solve_dtype(points1.device)
        with torch.inference_mode(False):  # a caller's inference mode has no gradients to offer
            x1, x2 = points1.detach().to(dtype).clone(), points2.detach().to(dtype).clone()
            w = None if weights is None else weights.detach().to(dtype).clone()
            with torch.no_grad():
                T1, T2 = self.base(x1, x2, w)
            with torch.enable_grad():
                params1, params2 = self._search(x1, x2, w, T1, T2)
        T1, T2 = self.transform(params1) @ T1, self.transform(params2) @ T2
        return T1.to(points1.dtype), T2.to(points2.dtype)

    def _search(self, x1: Tensor, x2: Tensor, w: Tensor | None, T1: Tensor, T2: Tensor) -> tuple[Tensor, Tensor]:
        """Return the best parameters met, ``(B, P)`` of each view."""
        free = x1.new_zeros(2, len(x1), self.num_parameters, requires_grad=True)
        best, least = torch.zeros_like(free), x1.new_full((len(x1),), torch.inf)
        optimizer = torch.optim.Adam([free], lr=self.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.steps)
        for _ in range(self.steps):
            params = _BOUND * torch.tanh(free / _BOUND)
            transforms = self.transform(params[0]) @ T1, self.transform(params[1]) @ T2
            F_mat = find_fundamental(x1, x2, w, lambda *_, found=transforms: found)
            distance = weighted_mean(symmetric_epipolar_distance(x1, x2, F_mat)[..., None], w)[:, 0]
            better = distance.detach() < least
            least = torch.where(better, distance.detach(), least)
            best = torch.where(better[:, None], params.detach(), best)
            # Adam works on every number by itself: the sum keeps the samples apart.
            (free.grad,) = torch.autograd.grad((distance + torch.finfo(x1.dtype).tiny).log().sum(), free)
            optimizer.step()
            schedule.step()
        return best[0], best[1]
