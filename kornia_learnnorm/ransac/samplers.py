r"""Minimal samples of eight correspondences or any size: uniform, by rank (PROSAC), and in proportion to weights."""

from typing import Protocol

import torch
from torch import Tensor

SAMPLE_SIZE = 8  # correspondences in a sample unless another size is asked for
MAX_RANDOM_NUMBERS = 1 << 22  # random numbers in memory at once
MIN_WEIGHT = 1e-30  # smallest positive weight, relative to the largest


class Sampler(Protocol):
    """Protocol of a sampler for RANSAC."""

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the indices of the next ``count`` minimal samples, (count, size) int64."""

    def hit_rate(self, inliers: Tensor, rows: Tensor | slice) -> float:
        """Return the probability that a sample holds no outlier, from the inliers (M,) among ``rows``."""


def draw_distinct(totals: Tensor, size: int, generator: torch.Generator) -> Tensor:
    r"""Draw sets of distinct indices, each set uniformly from its own range.

    Floyd's algorithm, a column at a time: the :math:`k`-th draws from the first :math:`n - s + k + 1` indices and,
    where it meets one that is there, takes the last of these instead.

    Reference:
        J. Bentley, R. Floyd, Programming pearls: a sample of brilliance, CACM 1987.
    """
    last = totals[:, None] - size + torch.arange(size, device=totals.device)
    uniform = torch.rand(len(totals), size, generator=generator, device=totals.device, dtype=torch.float32)
    drawn = (uniform * (last + 1)).long().clamp_(max=last)
    for k, (column, end) in enumerate(zip(drawn.unbind(-1)[1:], last.unbind(-1)[1:], strict=True), 1):
        met = (drawn[:, :k] == column[:, None]).any(-1)
        torch.where(met, end, column, out=column)
    return drawn


class UniformSampler:
    """Uniform samples of so many correspondences."""

    def __init__(self, total: int, device: torch.device, size: int = SAMPLE_SIZE) -> None:
        self.total, self.device, self.size = total, device, size

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the indices of the next samples."""
        # Of many correspondences, those that are drawn one by one are nearly always distinct.
        spare = count // 4 + self.size
        drawn = torch.randint(self.total, (count + spare, self.size), generator=generator, device=self.device)
        ordered = drawn.sort(-1).values
        drawn = drawn[(ordered[:, 1:] > ordered[:, :-1]).all(-1)][:count]
        if len(drawn) == count:
            return drawn
        totals = torch.full((count - len(drawn),), self.total, device=self.device)
        return torch.cat([drawn, draw_distinct(totals, self.size, generator)])

    def hit_rate(self, inliers: Tensor, rows: Tensor | slice) -> float:
        """Return the share of inliers to the power of the sample's size."""
        return float(inliers.float().mean()) ** self.size


class ProsacSampler:
    r"""PROSAC: samples from a growing set of the best-weighted correspondences.

    The :math:`t`-th sample holds the :math:`n(t)`-th best correspondence, all others in it are better ones, and
    :math:`n(t)` grows as if 200,000 uniform samples were ordered by their worst member. Only the order of the weights
    counts; correspondences of weight zero are never drawn.

    Args:
        weights: scores, higher is better, (N,), at least as many of them positive as a sample holds.
        size: correspondences in a sample.

    Reference:
        O. Chum, J. Matas, Matching with PROSAC, CVPR 2005, section 2.
    """

    MAX_SAMPLES = 200_000  # uniform samples whose order PROSAC follows
    MIN_SHARE = 0.25  # smallest share of the best correspondences whose inliers may stop the sampling

    def __init__(self, weights: Tensor, size: int = SAMPLE_SIZE) -> None:
        self.weights, self.size = weights, size
        order = weights.argsort(descending=True, stable=True)
        self.order = order[weights[order] > 0]
        total = len(self.order)
        sizes = torch.arange(size, total + 1, dtype=torch.float64)
        taken = torch.arange(size, dtype=torch.float64)
        expected = self.MAX_SAMPLES * ((sizes[:, None] - taken) / (total - taken)).prod(-1)
        until = torch.cat([expected.new_ones(1), 1 + expected.diff().ceil().cumsum(-1)])
        self.until, self.drawn = until.long().to(weights.device), 0  # samples among the best size, size + 1, ...

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the indices of the next samples; how many there were before counts."""
        total, device = len(self.order), self.order.device
        t = torch.arange(self.drawn + 1, self.drawn + count + 1, device=device)
        self.drawn += count
        grown = torch.searchsorted(self.until, t)
        last = (grown + self.size - 1).clamp(max=total - 1)
        ranked = torch.cat([draw_distinct(last, self.size - 1, generator), last[:, None]], -1)
        uniform = draw_distinct(torch.full_like(last, total), self.size, generator)
        return self.order[torch.where(grown[:, None] < len(self.until), ranked, uniform)]

    def hit_rate(self, inliers: Tensor, rows: Tensor | slice) -> float:
        """Return the largest share of inliers among the best correspondences to the power of the size."""
        weights = self.weights[rows]
        order = weights.argsort(descending=True, stable=True)[: int((weights > 0).sum())]
        if len(order) == 0:
            return 0.0
        ranked = inliers[order].cpu().double()
        shares = ranked.cumsum(-1) / torch.arange(1, len(ranked) + 1)
        return float(shares[int(self.MIN_SHARE * len(shares)) :].max() ** self.size)


class WeightedSampler:
    """Samples with probability in proportion to weights, without replacement; weight zero is never drawn.

    Args:
        weights: non-negative weights, (N,), at least as many of them positive as a sample holds.
        size: correspondences in a sample.

    Reference:
        P. Efraimidis, P. Spirakis, Weighted random sampling with a reservoir, Information Processing Letters 2006.
    """

    def __init__(self, weights: Tensor, size: int = SAMPLE_SIZE) -> None:
        self.size = size
        share = weights.double() / weights.max().double()
        self.weights = torch.where(share > 0, share.clamp(min=MIN_WEIGHT), 0.0).float()

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the indices of the next samples."""
        blocks = torch.split(torch.arange(count), max(1, MAX_RANDOM_NUMBERS // len(self.weights)))
        return torch.cat([self._draw_block(len(block), generator) for block in blocks])

    def _draw_block(self, count: int, generator: torch.Generator) -> Tensor:
        uniform = torch.rand(
            count, len(self.weights), generator=generator, device=self.weights.device, dtype=torch.float32
        )
        return (uniform.clamp_(min=MIN_WEIGHT).log() / self.weights).topk(self.size).indices

    def hit_rate(self, inliers: Tensor, rows: Tensor | slice) -> float:
        """Return the share of the weights that inliers have to the power of the size."""
        weights = self.weights[rows].cpu().double()
        return float(((weights * inliers.cpu()).sum() / weights.sum()) ** self.size)
