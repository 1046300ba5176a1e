r"""The better rate: on how many samples one method leaves a smaller residual than another."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

__all__ = ["BetterRate", "better_rate", "comparable"]


class BetterRate(NamedTuple):
    """How often one method's residual is below another's."""

    rate: float  # share of the compared samples with a strictly smaller residual
    ties: int  # equal pairs, counted as not better
    degenerate: int  # samples left out because a residual is NaN or both are infinite
    compared: int  # samples compared


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
    better, ties = (int(kind[valid].sum()) for kind in (residual < baseline, residual == baseline))
    return BetterRate(better / compared, ties, len(residual) - compared, compared)


def comparable(residual: Tensor, baseline: Tensor) -> Tensor:
    """Return where two residuals can be compared: neither is NaN and one at least is finite, boolean."""
    return ~(residual.isnan() | baseline.isnan() | (residual.isinf() & baseline.isinf()))
