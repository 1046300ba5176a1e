"""Input checks and helpers shared by all modules."""

from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import NoReturn

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.core.exceptions import ShapeError
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.forward_ad import unpack_dual


def solve_dtype(device: torch.device) -> torch.dtype:
    """Return the dtype of the small linear algebra: float64, or float32 on MPS, which has no float64."""
    return torch.float32 if device.type == "mps" else torch.float64


def check_tensor(name: str, value: object, shape: Sequence[str] | None = None, precise: bool = False) -> None:
    """Raise a TypeError for anything but a floating-point tensor, and a ShapeError for a wrong shape.

    ``shape`` is that of ``KORNIA_CHECK_SHAPE``, None for any; ``precise`` accepts float32 and float64 only.
    """
    kind = "a float32 or float64 tensor" if precise else "a floating-point tensor"
    if not isinstance(value, Tensor):
        hint = f"; torch.from_numpy({name}) makes it one" if type(value).__module__ == "numpy" else ""
        raise TypeError(f"{name} must be {kind}, got {type(value)}{hint}")
    if not (value.dtype in (torch.float32, torch.float64) if precise else value.is_floating_point()):
        raise TypeError(f"{name} must be {kind}, got {value.dtype}")
    if shape is not None and not KORNIA_CHECK_SHAPE(value, [*shape], raises=False):
        hint = f"; for one pair write {name}[None]" if shape[0] == "B" and value.ndim == len(shape) - 1 else ""
        hint = f"; this takes one pair, {name}[0]" if shape[0] == "N" and value.ndim == len(shape) + 1 else hint
        message = f"{name} must have shape ({', '.join(shape)}), got {[*value.shape]}{hint}"
        raise ShapeError(message, actual_shape=[*value.shape], expected_shape=[*shape])


def check_cameras(K1: Tensor | None, K2: Tensor | None, batch_size: int | None = None) -> None:
    """Raise a clear error for anything but two finite and invertible cameras with a last row (0, 0, w > 0), or none.

    Cameras are (3, 3), or where there is a ``batch_size`` also (1, 3, 3) and (B, 3, 3). A last row of other numbers is
    a ValueError that names a transposed camera.
    """
    if (K1 is None) != (K2 is None):
        raise ValueError(f"K1 and K2 must be given together, got only {'K1' if K2 is None else 'K2'}")
    shapes = [[3, 3]] if batch_size is None else [[3, 3], [batch_size, 3, 3], [1, 3, 3]]
    for name, K in (("K1", K1), ("K2", K2)):
        if K is None:
            continue
        check_tensor(name, K)
        if [*K.shape] not in shapes:
            expected = " or ".join(dict.fromkeys(map(str, shapes)))
            raise ValueError(f"{name} must have shape {expected}, got {[*K.shape]}")
        wrong = ~K.isfinite().flatten(-2).all(-1) | (torch.linalg.det(K.detach().to(solve_dtype(K.device))) == 0)
        if read_condition(wrong.any()):
            raise ValueError(f"{name} must be finite and invertible, got {K.detach()[wrong][0].tolist()}")
        wrong = (K[..., 2, :2] != 0).any(-1) | (K[..., 2, 2] <= 0)
        if read_condition(wrong.any()):
            got = " ".join(f"{value:g}" for value in K.detach()[wrong][0, 2].tolist())
            raise ValueError(f"{name} must have a last row of 0 0 1, up to a positive scale, got {got}; transposed?")


def check_correspondences(points1: Tensor, points2: Tensor, weights: Tensor | None = None, min_points: int = 8) -> None:
    """Raise a clear error for anything but finite correspondences ``(B, N, 2)`` x 2 and weights ``(B, N)``.

    Points must be float32 or float64 of one dtype and device, at least ``min_points``, and weights not negative.
    """
    check_pairs(points1, points2, ["B", "N", "2"])
    if points2.device != points1.device or (isinstance(weights, Tensor) and weights.device != points1.device):
        devices = {str(tensor.device) for tensor in (points1, points2, weights) if tensor is not None}
        raise ValueError(f"points and weights must be on one device, got {' and '.join(sorted(devices))}")
    if points1.shape[1] < min_points:
        raise ValueError(f"at least {min_points} correspondences are needed, got {points1.shape[1]}")
    valid = (points1.sum() + points2.sum()).isfinite()  # or the sum overflows
    if weights is not None:
        if isinstance(weights, Tensor) and weights.dtype == torch.bool:
            raise TypeError("weights must be a floating-point tensor, got torch.bool; a boolean tensor is a mask")
        check_tensor("weights", weights)
        if weights.shape != points1.shape[:2]:
            raise ValueError(f"weights must have shape {[*points1.shape[:2]]}, got {[*weights.shape]}")
        valid = valid & ~(weights < 0).any() & weights.sum().isfinite()
    if read_condition(~valid):  # one look at the device for all values
        for name, values in (("points1", points1), ("points2", points2), ("weights", weights)):
            if values is not None and (bad := int((~values.isfinite()).sum())):
                raise ValueError(f"{name} must be finite, got {bad} NaN or infinite values")
        if weights is not None and bool((weights < 0).any()):
            raise ValueError(f"weights must not be negative, got a minimum of {weights.min().item():g}")


def check_pairs(points1: Tensor, points2: Tensor, shape: Sequence[str]) -> None:
    """Raise a clear error for anything but two tensors of points of a shape, of one precise dtype, that pair up."""
    check_tensor("points1", points1, shape, precise=True)
    check_tensor("points2", points2, shape, precise=True)
    if points1.dtype != points2.dtype:
        raise TypeError(f"points1 and points2 must have one dtype, got {points1.dtype} and {points2.dtype}")
    if points1.shape != points2.shape:
        raise ValueError(f"points1 and points2 must pair up, got shapes {[*points1.shape]} and {[*points2.shape]}")


def check_mask(mask: Tensor, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> None:
    """Raise a clear error for a mask that does not fit correspondences ``(B, N, 2)`` and weights ``(B, N)``."""
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        raise TypeError(f"mask must be a boolean tensor, got {mask.dtype if isinstance(mask, Tensor) else type(mask)}")
    shapes = {"points1": points1.shape[:-1], "points2": points2.shape[:-1]}
    shapes |= {} if weights is None else {"weights": weights.shape}
    for name, shape in shapes.items():
        if shape != mask.shape:
            raise ValueError(f"mask must have shape {[*shape]} as {name}, got {[*mask.shape]}")
    if mask.device != points1.device:
        raise ValueError(f"mask and points must be on one device, got {mask.device} and {points1.device}")


def check_matrices(name: str, matrices: Tensor, number: int) -> None:
    """Raise a clear error for anything but so many finite matrices ``(B, 3, 3)`` other than zero."""
    check_number_of_matrices(name, matrices, number)
    if read_condition(~matrices.isfinite().all()):
        raise ValueError(f"{name} must be finite, got {int((~matrices.isfinite()).sum())} NaN or infinite values")
    zero = (matrices == 0).all(-1).all(-1)
    if read_condition(zero.any()):
        raise ValueError(f"{name} must not be zero, got {int(zero.sum())} zero matrices")


def check_number_of_matrices(name: str, matrices: Tensor, number: int) -> None:
    """Raise a clear error for anything but so many matrices ``(B, 3, 3)``, of any values."""
    check_tensor(name, matrices, ["B", "3", "3"])
    if len(matrices) != number:
        raise ValueError(f"one matrix per set of points is needed, got {len(matrices)} matrices and {number} sets")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise a ValueError for anything but one of the choices."""
    if value not in choices:
        raise ValueError(f"{name} must be {' or '.join(map(repr, choices))}, got {value!r}")


def read_condition(condition: Tensor) -> bool | None:
    """Return a boolean scalar's value; None where it cannot be read: in ``torch.compile`` and ``torch.func.vmap``."""
    if torch.compiler.is_compiling():
        return None
    try:
        return bool(condition)
    except RuntimeError:
        return None


def is_known_true(condition: Tensor) -> bool:
    """Return whether a boolean scalar is true, and known to be without waiting for a device."""
    return condition.device.type == "cpu" and read_condition(condition) is True


def check_whole_number(name: str, value: object, least: int) -> None:
    """Raise a ValueError for anything but a whole number of at least ``least``."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} must be a whole number, at least {least}, got {value!r}")


def needs_gradient(*values: Tensor | None) -> bool:
    """Return whether derivatives by a tensor may be asked for; true where that cannot be told, as inside ``vmap``."""
    if not torch.is_grad_enabled():
        return False
    if torch.compiler.is_compiling():
        return True
    for value in values:
        if value is None:
            continue
        wrapped = torch._C._functorch.is_functorch_wrapped_tensor(value)  # noqa: SLF001 (there is no public name)
        if value.requires_grad or wrapped or unpack_dual(value).tangent is not None:  # type: ignore[no-untyped-call]
            return True
    return False


def inference_mode() -> AbstractContextManager[object]:
    """Return PyTorch's inference mode, in which operations cost less, where gradients are disabled.

    Not inside ``torch.compile``, and transforms such as ``vmap`` or forward-mode differentiation. What is made in it
    must be cloned outside of it before it leaves a layer.
    """
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return nullcontext()
    transformed = torch._C._functorch.peek_interpreter_stack() is not None  # noqa: SLF001 (there are no public names)
    return nullcontext() if transformed or forward_ad._current_level >= 0 else torch.inference_mode()  # noqa: SLF001


def without_autocast(points: Tensor) -> AbstractContextManager[object]:
    """Return a context in which autocast is off: pixels have more digits than its dtypes hold."""
    device = points.device.type
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


def weighted_mean(values: Tensor, weights: Tensor | None) -> Tensor:
    """Average over the points ``(B, N, C) -> (B, C)``; weights that sum to zero count as equal."""
    if weights is None:
        return values.mean(-2)
    total = weights.sum(-1, keepdim=True)
    empty = total == 0
    # On a CPU, a product with a row is faster than a sum over the last axis but one.
    return ((weights + empty)[..., None, :] @ values)[..., 0, :] / (total + weights.shape[-1] * empty)


def safe_divisor(values: Tensor) -> Tensor:
    """Return non-negative values with 1 in place of zeros, to divide by."""
    return values + (values == 0)  # cheaper than `where`, which makes a tensor of the number


def refuse_jit() -> NoReturn:
    """Raise a TypeError that says what to use instead of ``torch.jit``."""
    raise TypeError("this layer cannot be compiled by torch.jit, use torch.compile or torch.export")
