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

BATCH_SIZE = 8192  # samples solved at once, which bounds the memory


def plain_residual(points1: Tensor, points2: Tensor, batch_size: int = BATCH_SIZE) -> Tensor:
    """Return the mean symmetric epipolar distance of each sample under the un-normalised eight-point algorithm.

    Fan et al. drop samples of 60 px and more (section 4, training procedure).

    Args:
        points1: pixels in the first view with shape (S, N, 2).
        points2: pixels in the second view with shape (S, N, 2).
        batch_size: samples solved at once, which bounds the memory.

    Returns:
        pixels with shape (S,), float64.

    """
    identity, residuals = Identity(), []
    for x1, x2 in zip(*(torch.split(points.double(), batch_size) for points in (points1, points2)), strict=True):
        F_mat = find_fundamental(x1, x2, normalizer=identity)
        residuals.append(symmetric_epipolar_distance(x1, x2, F_mat).mean(-1))
    return torch.cat(residuals)


def cached_mask(
    folder: Path | None, about: Sequence[Any], points1: Tensor, points2: Tensor, max_residual: float
) -> Tensor:
    """Return which samples (S,) have a residual below a limit, from a file of the folder where it was computed before.

    Args:
        folder: folder of the cache; None for no cache.
        about: what the samples depend on, for JSON: the key of the file.
        points1: pixels in the first view with shape (S, N, 2).
        points2: pixels in the second view with shape (S, N, 2).
        max_residual: pixels.
    """
    if folder is None:
        return plain_residual(points1, points2) < max_residual
    path = folder / f"{sha256(json.dumps(about).encode()).hexdigest()[:32]}.npy"
    if path.is_file():
        return torch.from_numpy(np.load(path))
    kept = plain_residual(points1, points2) < max_residual
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        np.save(temporary, kept.numpy())
    return kept
