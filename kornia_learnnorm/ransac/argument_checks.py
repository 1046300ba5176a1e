"""Checks of RANSAC's arguments."""

from numbers import Integral, Real

import torch
from torch import Tensor

from kornia_learnnorm.geometry.checks import check_pairs, check_tensor


def check_numbers(
    inl_th: float, max_samples: int, max_seconds: float | None, confidence: float | None, seed: int | None
) -> None:
    """Raise a clear error for arguments that are not numbers, or out of range."""
    for name, value in {"inl_th": inl_th, "confidence": confidence, "max_seconds": max_seconds}.items():
        if (isinstance(value, bool) or not isinstance(value, Real)) and (value is not None or name == "inl_th"):
            raise TypeError(f"{name} must be a number, got {value!r}")
    if not 1e-12 <= inl_th <= 1e12:
        raise ValueError(f"inl_th must be a positive number of pixels, from 1e-12 to 1e12, got {inl_th}")
    if not _is_whole(max_samples) or max_samples < 1:
        raise ValueError(f"max_samples must be a whole number of samples, at least 1, got {max_samples}")
    if max_seconds is not None and not max_seconds > 0:
        raise ValueError(f"max_seconds must be positive or None, got {max_seconds}")
    if confidence is not None and not 0 < confidence <= 1:
        raise ValueError(f"confidence must lie in (0, 1], got {confidence}")
    if seed is not None and not _is_whole(seed):
        raise TypeError(f"seed must be a whole number or None, got {seed!r}")
    if seed is not None and not 0 <= seed < 2**63:
        raise ValueError(f"seed must lie in [0, 2^63), got {seed}")


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_matches(points1: Tensor, points2: Tensor, weights: Tensor | None, min_points: int) -> None:
    """Raise a clear error for matches of one pair that do not fit; points may be infinite or NaN."""
    check_pairs(points1, points2, ["N", "2"])
    if len(points1) < min_points:
        raise ValueError(f"at least {min_points} correspondences are needed, got {len(points1)}")
    if weights is None:
        return
    if isinstance(weights, Tensor) and weights.dtype == torch.bool:
        raise TypeError("weights must be a floating-point tensor, got torch.bool; select the rows of a boolean mask")
    check_tensor("weights", weights)
    if weights.shape != points1.shape[:1]:
        raise ValueError(f"weights must have shape {[*points1.shape[:1]]}, got {[*weights.shape]}")
    known = weights[(points1.isfinite() & points2.isfinite()).all(-1)]
    if not bool(known.isfinite().all()) or bool((known < 0).any()):
        wrong = int((~known.isfinite() | (known < 0)).sum())
        raise ValueError(f"weights must be finite and not negative where the points are finite, got {wrong} others")
