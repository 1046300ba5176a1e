"""Statistics of errors over samples: the median, better rates, and bootstraps over image pairs."""

from typing import NamedTuple

import torch
from torch import Tensor


def median(values: Tensor, dim: int = -1) -> Tensor:
    """Return the median over ``dim``: the middle value, or the mean of the two middle ones.

    NaN values are left out, infinite ones count. NaN where no number is left.
    """
    if values.shape[dim] == 0:
        return values.sum(dim) * torch.nan
    # Interpolating between the two would make NaN of infinite ones.
    low, high = (values.nanquantile(0.5, dim, interpolation=kind) for kind in ("lower", "higher"))
    return (low + high) / 2


class BetterRate(NamedTuple):
    """How often one method's residual is below another's."""

    rate: float  # share of the compared samples with a strictly smaller residual
    ties: int  # equal pairs, counted as not better
    degenerate: int  # samples left out because a residual is NaN or both are infinite
    compared: int  # samples compared


def better_rate(residual: Tensor, baseline: Tensor) -> BetterRate:
    """Compare residuals (S,) of two methods, strict ``<``, sample by sample (the better rate of Fan et al., Table 1).

    ValueError if the shapes differ or nothing can be compared.

    Example:
        >>> better_rate(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 2.0, 1.0]))
        BetterRate(rate=0.333..., ties=1, degenerate=0, compared=3)
    """
    if residual.shape != baseline.shape or residual.ndim != 1:
        raise ValueError(f"residuals must be two (S,) tensors, got {[*residual.shape]} and {[*baseline.shape]}")
    valid = comparable(residual, baseline)
    compared = int(valid.sum())
    if compared == 0:
        raise ValueError(f"none of {len(residual)} samples can be compared")
    better, ties = (int(kind[valid].sum()) for kind in (residual < baseline, residual == baseline))
    return BetterRate(better / compared, ties, len(residual) - compared, compared)


def comparable(residual: Tensor, baseline: Tensor) -> Tensor:
    """Return where two residuals can be compared: neither is NaN and one at least is finite, boolean."""
    return ~(residual.isnan() | baseline.isnan() | (residual.isinf() & baseline.isinf()))


def bootstrap_interval(values: Tensor, groups: Tensor, draws: int = 2000) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of a mean whose samples come in groups.

    The groups are drawn with replacement, each with all its samples (the cluster bootstrap). The interval of few groups
    is too narrow; reports have none for fewer than eight.

    Args:
        values: one value per sample with shape (S,).
        groups: index of each sample's group, its image pair, with shape (S,), integers.
        draws: number of draws.

    ValueError if the shapes differ or there are fewer than two groups.

    Reference:
        A. Davison, D. Hinkley, Bootstrap Methods and their Application, 1997, sections 3.8 and 5.3.

    Example:
        >>> bootstrap_interval(torch.tensor([1.0, 1.0, 0.0, 0.0]), torch.tensor([0, 0, 1, 1]))
        (0.0, 1.0)
    """
    return _bootstrap(values, groups, draws)[1:]


def _bootstrap(values: Tensor, groups: Tensor, draws: int) -> tuple[Tensor, float, float]:
    """Return the mean of each draw of whole groups, (draws,) float64, and the ends of their middle 95 %."""
    if values.shape != groups.shape or values.ndim != 1:
        raise ValueError(f"values and groups must be two (S,) tensors, got {[*values.shape]} and {[*groups.shape]}")
    present, group = torch.unique(groups, return_inverse=True)
    if len(present) < 2:
        raise ValueError(f"at least two groups are needed, got {len(present)}")
    counts = torch.bincount(group).double()
    sums = torch.zeros_like(counts).index_add_(0, group, values.double())
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randint(len(present), (draws, len(present)), generator=generator).to(counts.device)
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    return means, means.quantile(0.025).item(), means.quantile(0.975).item()


class PairedDifference(NamedTuple):
    """How far the mean of one method is above another's on the same samples."""

    mean: float  # of values - baseline over samples
    low: float  # lower end of its bootstrap interval
    high: float  # upper end
    p_value: float  # two-sided, of no difference


def paired_bootstrap(values: Tensor, baseline: Tensor, groups: Tensor, draws: int = 2000) -> PairedDifference:
    r"""Compare the means of two methods on the same samples, (S,) each, by drawing whole image pairs with replacement.

    The p-value is that of the percentile interval which just reaches zero: with :math:`\bar d^*` the mean difference of
    a draw, :math:`p = 2 (1 + \min(|\{\bar d^* \le 0\}|, |\{\bar d^* \ge 0\}|)) / (1 + \text{draws})`, at most one. The
    other arguments and errors are those of :func:`bootstrap_interval`; also raises ValueError if a difference is not
    finite: drop such samples of both methods and count them.

    Reference:
        A. Davison, D. Hinkley, Bootstrap Methods and their Application, 1997, chapters 4 and 5.
    """
    if values.shape != baseline.shape or values.ndim != 1:
        raise ValueError(f"values must be two (S,) tensors, got {[*values.shape]} and {[*baseline.shape]}")
    difference = values.double() - baseline.double()
    if bad := int((~difference.isfinite()).sum()):
        raise ValueError(f"differences must be finite, got {bad} NaN or infinite ones of {len(difference)}")
    means, low, high = _bootstrap(difference, groups, draws)
    fewest = min(int((means <= 0).sum()), int((means >= 0).sum()))
    return PairedDifference(difference.mean().item(), low, high, min(1.0, 2 * (1 + fewest) / (1 + draws)))
