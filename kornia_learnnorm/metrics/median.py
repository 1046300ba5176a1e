"""The median of a tensor that may hold NaN and infinity."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["median"]


def median(values: Tensor, dim: int = -1) -> Tensor:
    """Return the median: the middle value, or the mean of the two middle ones. NaN values are left out.

    Args:
        values: numbers with at least one dimension; infinite ones count.
        dim: dimension to reduce.

    Returns:
        the medians without ``dim``; NaN where no number is left.

    Example:
        >>> median(torch.tensor([[4.0, 1.0, torch.nan, 3.0, 9.0], [torch.nan, 1.0, 2.0, 3.0, torch.nan]]))
        tensor([3.5000, 2.0000])

    """
    if values.shape[dim] == 0:
        return values.sum(dim) * torch.nan
    # Interpolating between the two would make NaN of infinite ones.
    low, high = (values.nanquantile(0.5, dim, interpolation=kind) for kind in ("lower", "higher"))
    return (low + high) / 2
