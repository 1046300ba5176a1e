"""The filter of samples by their residual: Fan et al. drop samples of 60 px and more before they train."""

from __future__ import annotations

import json
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.estimators.linear import find_fundamental
from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.normalizers.identity import Identity

__all__ = ["cached_mask", "plain_residual"]


def plain_residual(points1: Tensor, points2: Tensor, batch_size: int = 8192) -> Tensor:
    """Return the mean symmetric epipolar distance of each sample under the un-normalised eight-point algorithm.

    Args:
        points1: pixels in the first view with shape (S, N, 2).
        points2: pixels in the second view with shape (S, N, 2).
        batch_size: samples solved at once, which bounds the memory.

    Returns:
        pixels with shape (S,), float64. Fan et al. drop samples of 60 px and more (section 4, training procedure).

    """
    identity, residuals = Identity(), []
    for x1, x2 in zip(*(torch.split(points.double(), batch_size) for points in (points1, points2)), strict=True):
        F_mat = find_fundamental(x1, x2, normalizer=identity)
        residuals.append(symmetric_epipolar_distance(x1, x2, F_mat).mean(-1))
    return torch.cat(residuals)


def cached_mask(
    folder: Path | None, key: Sequence[Any], points1: Tensor, points2: Tensor, max_residual: float
) -> Tensor:
    """Return which samples (S, N, 2) have a residual below a limit in pixels, (S,) bool; with a folder, cached there.

    The file is named by the hash of ``key``, which holds what the samples depend on, for JSON.
    """
    path = folder and folder / f"{sha256(json.dumps(key).encode()).hexdigest()[:32]}.npy"
    if path and path.is_file():
        return torch.from_numpy(np.load(path))
    kept = plain_residual(points1, points2) < max_residual
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            np.save(temporary, kept.numpy())
    return kept
