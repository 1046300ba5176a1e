r"""Minimal samples of eight correspondences or any size: uniform, and in proportion to squared weights."""

import torch
from torch import Tensor

SAMPLE_SIZE = 8  # correspondences in a sample unless another size is asked for
MAX_RANDOM_NUMBERS = 1 << 22  # random numbers in memory at once
MIN_WEIGHT = 1e-30  # smallest positive weight, relative to the largest


def draw_distinct(totals: Tensor, size: int, generator: torch.Generator) -> Tensor:
    r"""Draw sets of distinct indices, each set uniformly from its own range.

    Floyd's algorithm, a column at a time: column :math:`k` draws from the first :math:`n - s + k + 1` indices and
    replaces an index that is already drawn by the last of these.

    Reference:
        J. Bentley, R. Floyd, Programming pearls: a sample of brilliance, CACM 1987.
    """
    last = totals[:, None] - size + torch.arange(size, device=totals.device)
    uniform = torch.rand(len(totals), size, generator=generator, device=totals.device, dtype=torch.float32)
    drawn = (uniform * (last + 1)).long().clamp_(max=last)
    for k, (column, end) in enumerate(zip(drawn.unbind(-1)[1:], last.unbind(-1)[1:], strict=True), 1):
        torch.where((drawn[:, :k] == column[:, None]).any(-1), end, column, out=column)
    return drawn


class UniformSampler:
    """Uniform samples of ``size`` correspondences. Both samplers return indices, (count, size) int64."""

    def __init__(self, total: int, device: torch.device, size: int = SAMPLE_SIZE) -> None:
        self.total, self.device, self.size = total, device, size

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the indices of the next samples."""
        # Among many correspondences, independent draws are nearly always distinct.
        spare = count // 4 + self.size
        drawn = torch.randint(self.total, (count + spare, self.size), generator=generator, device=self.device)
        ordered = drawn.sort(-1).values
        drawn = drawn[(ordered[:, 1:] > ordered[:, :-1]).all(-1)][:count]
        if len(drawn) == count:
            return drawn
        totals = torch.full((count - len(drawn),), self.total, device=self.device)
        return torch.cat([drawn, draw_distinct(totals, self.size, generator)])

    def hit_rate(self, inliers: Tensor, rows: Tensor | slice) -> float:
        """Return the probability of a sample without outliers, from the inliers (M,) among some rows."""
        return float(inliers.float().mean()) ** self.size

    def among(self, rows: Tensor) -> "Sampler":
        """Return a sampler of some rows (N,) bool; itself where they are too few for distinct samples."""
        return self if int(rows.sum()) < 2 * self.size else WeightedSampler(rows.float(), self.size)


class WeightedSampler:
    """Samples with probability in proportion to the squares of weights, without replacement.

    The square favours the best correspondences where most are outliers, and still draws all where few are. Weights (N,)
    are non-negative, and at least ``size`` of them positive; a correspondence of weight zero is never drawn.

    Reference:
        P. Efraimidis, P. Spirakis, Weighted random sampling with a reservoir, Information Processing Letters 2006.
    """

    def __init__(self, weights: Tensor, size: int = SAMPLE_SIZE) -> None:
        self.size = size
        share = weights.double() / weights.max().double()
        self.weights = torch.where(share > 0, share.square().clamp(min=MIN_WEIGHT), 0.0)
        self.upto = self.weights.cpu().cumsum(-1).to(weights.device)  # on a GPU sums differ from call to call

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the indices of the next samples."""
        # The first distinct indices among twice as many independent draws are a sample without replacement.
        uniform = torch.rand(count, 2 * self.size, generator=generator, device=self.upto.device, dtype=self.upto.dtype)
        drawn = torch.searchsorted(self.upto, uniform * self.upto[-1], right=True)
        repeats = (drawn[:, :, None] == drawn[:, None]).tril(-1).any(-1)
        kept = ~repeats & (drawn < len(self.upto))
        kept &= kept.cumsum(-1) <= self.size
        full = kept.sum(-1) == self.size
        drawn = drawn[full][kept[full]].view(-1, self.size)
        blocks = torch.split(torch.arange(count - len(drawn)), max(1, MAX_RANDOM_NUMBERS // len(self.upto)))
        return torch.cat([drawn, *(self._draw_block(len(block), generator) for block in blocks)])

    def _draw_block(self, count: int, generator: torch.Generator) -> Tensor:
        weights = self.weights.float()
        uniform = torch.rand(count, len(weights), generator=generator, device=weights.device, dtype=weights.dtype)
        return (uniform.clamp_(min=MIN_WEIGHT).log() / weights).topk(self.size).indices

    def hit_rate(self, inliers: Tensor, rows: Tensor | slice) -> float:
        """Return the probability of a sample without outliers, from the inliers (M,) among some rows."""
        weights = self.weights[rows].cpu()
        return float(((weights * inliers.cpu()).sum() / weights.sum()) ** self.size)

    def among(self, rows: Tensor) -> "Sampler":
        """Return a sampler of some rows (N,) bool; itself where too few of them have a weight for distinct samples."""
        weights = torch.where(rows, self.weights.sqrt(), 0.0)
        return self if int((weights > 0).sum()) < 2 * self.size else WeightedSampler(weights, self.size)


Sampler = UniformSampler | WeightedSampler
