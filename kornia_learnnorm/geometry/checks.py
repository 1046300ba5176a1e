"""What every module asks of correspondences: checks, the dtype to work in, averages."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor

__all__ = [
    "check_correspondences",
    "check_mask",
    "is_true",
    "solve_dtype",
    "weighted_mean",
]


def solve_dtype(device: torch.device) -> torch.dtype:
    """Return the dtype of the small linear algebra: float64, except on MPS, which has none."""
    return torch.float32 if device.type == "mps" else torch.float64


def check_correspondences(points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> None:
    """Raise a clear error for anything but finite correspondences ``(B, N, 2)`` x 2 and weights ``(B, N)``.

    Raises:
        TypeError: if the points are not floating-point tensors of one dtype, or the weights not floating-point.
        ShapeError: if a shape is wrong.
        ValueError: if shapes of the views differ, there are too few correspondences, a value is not finite, or a
            weight is negative.

    """
    for name, points in (("points1", points1), ("points2", points2)):
        if not isinstance(points, Tensor) or points.dtype not in (torch.float32, torch.float64):
            got = points.dtype if isinstance(points, Tensor) else type(points)
            raise TypeError(f"{name} must be a float32 or float64 tensor, got {got}")
        KORNIA_CHECK_SHAPE(points, ["B", "N", "2"])
    if points1.dtype != points2.dtype:
        raise TypeError(f"points1 and points2 must have one dtype, got {points1.dtype} and {points2.dtype}")
    if points1.shape != points2.shape:
        raise ValueError(f"points1 and points2 must pair up, got shapes {[*points1.shape]} and {[*points2.shape]}")
    devices = {str(tensor.device) for tensor in (points1, points2, weights) if isinstance(tensor, Tensor)}
    if len(devices) > 1:
        raise ValueError(f"points and weights must be on one device, got {' and '.join(sorted(devices))}")
    if points1.shape[1] < 8:
        raise ValueError(f"at least 8 correspondences are needed, got {points1.shape[1]}")
    finite = [points1, points2]
    if weights is not None:
        if not isinstance(weights, Tensor) or not weights.is_floating_point():
            got = weights.dtype if isinstance(weights, Tensor) else type(weights)
            hint = "; a boolean tensor is a mask" if got == torch.bool else ""
            raise TypeError(f"weights must be a floating-point tensor, got {got}{hint}")
        if weights.shape != points1.shape[:2]:
            raise ValueError(f"weights must have shape {[*points1.shape[:2]]}, got {[*weights.shape]}")
        finite.append(weights)
    for name, values in zip(("points1", "points2", "weights"), finite, strict=False):
        if is_true(~values.isfinite().all()):
            bad = int((~values.isfinite()).sum())
            raise ValueError(f"{name} must be finite, got {bad} NaN or infinite values")
    if weights is not None and is_true((weights < 0).any()):
        raise ValueError(f"weights must not be negative, got a minimum of {weights.min().item():g}")


def check_mask(mask: Tensor, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> None:
    """Raise a clear error for a mask that does not fit correspondences ``(B, N, 2)`` and weights ``(B, N)``.

    Raises:
        TypeError: if the mask is not boolean.
        ValueError: if its shape is not ``(B, N)``, or the weights' is not.

    """
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        raise TypeError(f"mask must be a boolean tensor, got {getattr(mask, 'dtype', type(mask))}")
    shapes = {"points1": points1.shape[:-1], "points2": points2.shape[:-1]}
    shapes |= {} if weights is None else {"weights": weights.shape}
    for name, shape in shapes.items():
        if shape != mask.shape:
            raise ValueError(f"mask must have shape {[*shape]} as {name}, got {[*mask.shape]}")


def is_true(condition: Tensor) -> bool:
    """Value of a boolean scalar; false where none can be looked at: in ``torch.compile`` and ``torch.func.vmap``."""
    if torch.compiler.is_compiling():
        return False
    try:
        return bool(condition)
    except RuntimeError:
        return False


def weighted_mean(values: Tensor, weights: Tensor | None) -> Tensor:
    """Average over the points ``(B, N, C) -> (B, C)``; weights that sum to zero count as equal."""
    if weights is None:
        return values.mean(-2)
    total = weights.sum(-1, keepdim=True)
    empty = total <= 0
    weights = torch.where(empty, 1.0, weights)
    return (weights[..., None] * values).sum(-2) / torch.where(empty, weights.shape[-1], total)
