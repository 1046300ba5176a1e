"""The checks of shapes and the dtype that all modules share."""

import torch
from kornia.core.exceptions import ShapeError
from scenes import raises

from kornia_learnnorm.geometry.checks import check_tensor, solve_dtype


def test_a_wrong_shape_names_what_to_write():
    for points, shape, hint in [
        (torch.rand(9, 2), ["B", "N", "2"], r"for one pair write points1\[None\]"),
        (torch.rand(1, 9, 2), ["N", "2"], r"this takes one pair, points1\[0\]"),
        (torch.rand(9), ["B", "N", "2"], r"^points1 must have shape \(B, N, 2\), got \[9\]$"),
    ]:
        raises(ShapeError, hint, check_tensor, "points1", points, shape)
        raises(TypeError, r"numpy.ndarray.*torch.from_numpy\(points1\)", check_tensor, "points1", points.numpy(), shape)


def test_solve_dtype():
    found = [solve_dtype(torch.device(name)) for name in ("cpu", "cuda:0", "mps")]
    assert found == [torch.float64, torch.float64, torch.float32]
