"""The median of a tensor that may hold NaN and infinity."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["median"]


def median(values: Tensor, dim: int = -1) -> Tensor:
    """Return the median over ``dim``: the middle value, or the mean of the two middle ones.

    NaN values are left out, infinite ones count. NaN where no number is left.
    """
    if values.shape[dim] == 0:
        return values.sum(dim) * torch.nan
    # Interpolating between the two would make NaN of infinite ones.
    low, high = (values.nanquantile(0.5, dim, interpolation=kind) for kind in ("lower", "higher"))
    return (low + high) / 2
