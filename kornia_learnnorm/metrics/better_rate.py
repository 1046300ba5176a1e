r"""Metrics: pure functions from residuals or matrices to figures."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["BetterRate", "better_rate", "bootstrap_interval", "bootstrap_means", "comparable", "percentile_interval"]


class BetterRate(NamedTuple):
    """How often one method's residual is below another's.

    Attributes:
        rate: share of the compared samples with a strictly smaller residual.
        ties: number of equal pairs, counted as not better.
        degenerate: number of samples left out because a residual is NaN or both are infinite.
        compared: number of samples compared.
    """

    rate: float
    ties: int
    degenerate: int
    compared: int


def better_rate(residual: Tensor, baseline: Tensor) -> BetterRate:
    """Compare two methods sample by sample (the better rate of Fan et al., Table 1).

    Args:
        residual: one residual per sample with shape (S,).
        baseline: the baseline's residuals with shape (S,).

    Returns:
        the rate, strict ``<``, with ties and degenerate samples counted.

    Raises:
        ValueError: if the shapes differ or nothing can be compared.

    Example:
        >>> import torch
        >>> better_rate(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 2.0, 1.0]))
        BetterRate(rate=0.333..., ties=1, degenerate=0, compared=3)

    """
    if residual.shape != baseline.shape or residual.ndim != 1:
        raise ValueError(f"residuals must be two (S,) tensors, got {[*residual.shape]} and {[*baseline.shape]}")
    valid = comparable(residual, baseline)
    compared = int(valid.sum())
    if compared == 0:
        raise ValueError(f"none of {len(residual)} samples can be compared")
    better = int((residual < baseline)[valid].sum())
    ties = int((residual == baseline)[valid].sum())
    return BetterRate(better / compared, ties, len(residual) - compared, compared)


def comparable(residual: Tensor, baseline: Tensor) -> Tensor:
    """Return where two residuals can be compared: neither is NaN and one at least is finite, boolean."""
    return ~(residual.isnan() | baseline.isnan() | (residual.isinf() & baseline.isinf()))


def bootstrap_interval(
    values: Tensor, groups: Tensor, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Return the percentile bootstrap interval of a mean whose samples come in groups.

    Samples of one image pair share its motion and scene, so the groups are drawn with replacement, each with all its
    samples (the cluster bootstrap).

    Args:
        values: one value per sample with shape (S,).
        groups: index of each sample's group, its image pair, with shape (S,), integers.
        level: share of the draws within the interval.
        draws: number of draws.
        seed: seed of the draws.

    Returns:
        lower and upper end.

    Raises:
        ValueError: if the shapes differ, there are fewer than two groups, or ``level`` is not between 0 and 1.

    Reference:
        A. Davison, D. Hinkley, Bootstrap Methods and their Application, 1997, sections 3.8 and 5.3.

    Example:
        >>> bootstrap_interval(torch.tensor([1.0, 1.0, 0.0, 0.0]), torch.tensor([0, 0, 1, 1]))
        (0.0, 1.0)

    """
    return percentile_interval(bootstrap_means(values, groups, draws, seed), level)


def percentile_interval(means: Tensor, level: float = 0.95) -> tuple[float, float]:
    """Return the lower and upper end of the middle share ``level`` of a bootstrap's draws.

    Args:
        means: what :func:`bootstrap_means` returns.
        level: share of the draws within the interval.

    Raises:
        ValueError: if ``level`` is not between 0 and 1.

    Example:
        >>> percentile_interval(torch.arange(5.0), 0.5)
        (1.0, 3.0)

    """
    if not 0 < level < 1:
        raise ValueError(f"level must be between 0 and 1, got {level}")
    return means.quantile((1 - level) / 2).item(), means.quantile((1 + level) / 2).item()


def bootstrap_means(values: Tensor, groups: Tensor, draws: int = 2000, seed: int = 0) -> Tensor:
    """Return the mean of each draw of whole groups with replacement, (draws,) float64.

    Args:
        values: one value per sample with shape (S,).
        groups: index of each sample's group with shape (S,), integers.
        draws: number of draws.
        seed: seed of the draws.

    Raises:
        ValueError: if the shapes differ or there are fewer than two groups.

    Example:
        >>> means = bootstrap_means(torch.tensor([1.0, 1.0, 0.0, 0.0]), torch.tensor([0, 0, 1, 1]))
        >>> means.unique().tolist()
        [0.0, 0.5, 1.0]

    """
    if values.shape != groups.shape or values.ndim != 1:
        raise ValueError(f"values and groups must be two (S,) tensors, got {[*values.shape]} and {[*groups.shape]}")
    present, group = torch.unique(groups, return_inverse=True)
    if len(present) < 2:
        raise ValueError(f"at least two groups are needed, got {len(present)}")
    counts = torch.bincount(group).double()
    sums = torch.zeros_like(counts).index_add_(0, group, values.double())
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(len(present), (draws, len(present)), generator=generator).to(counts.device)
    return sums[drawn].sum(1) / counts[drawn].sum(1)
