"""The maximum over the points of a set."""

from __future__ import annotations

import torch
from torch import Tensor


def set_maximum(features: Tensor, absent: Tensor | None, dim: int, keepdim: bool = False) -> Tensor:
    """Return the maximum over the present points along ``dim``, zero where all are absent.

    ``absent`` marks the rows that are no points and broadcasts to the features. The gradient goes to one point for each
    maximum.
    """
    if absent is not None:
        features = torch.where(absent, -torch.inf, features)
    # Not `amax` with a gradient: torch.compile makes NaN of it under autocast to bfloat16, since it compares the
    # maximum, which is rounded, with features computed again, which are not. Without one, `amax` is faster for eights.
    maximum = features.max(dim, keepdim).values if features.requires_grad else features.amax(dim, keepdim)
    return maximum if absent is None else torch.where(absent.all(dim, keepdim), 0.0, maximum)
