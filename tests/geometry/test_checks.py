"""The checks, the dtype and the averages that all modules share."""

import pytest
import torch
from kornia.core.exceptions import ShapeError
from scenes import raises

from kornia_learnnorm.geometry.checks import check_cameras, check_tensor, solve_dtype

K = torch.tensor([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]])


def focal_length(camera):
    check_cameras(camera, camera)
    return camera[0, 0]


class TestCameras:
    @pytest.mark.parametrize("scale", [1.0, 2.0, 1e-3])
    def test_any_scale(self, scale):
        check_cameras(scale * K[None], K.expand(4, 3, 3), 4)

    def test_exceptions(self):
        for K1, K2, error, message in [
            (K, None, ValueError, "got only K1"),
            (None, K, ValueError, "got only K2"),
            (K, torch.zeros(3, 3), ValueError, "K2 must be finite and invertible"),
            (torch.full((3, 3), torch.nan), K, ValueError, r"K1 must be finite and invertible, got \[\[nan"),
            (torch.rand(3, 4), K, ValueError, r"K1 .* \[2, 3, 3\] or \[1, 3, 3\], got \[3, 4\]"),
            (K, K.expand(4, 3, 3), ValueError, r"K2 .* got \[4, 3, 3\]"),
            (K.long(), K, TypeError, r"K1 must be a floating-point tensor, got torch\.int64"),
            *((wrong, K, ValueError, f"^K1 .*got {r}; tr") for wrong, r in ((K.T, "320 240 1"), (-K, "-0 -0 -1"))),
            (K, torch.stack([K, K.T]).requires_grad_(), ValueError, r"^K2 .*320 240 1.*transposed"),
        ]:
            raises(error, message, check_cameras, K1, K2, 2)

    def test_values_are_not_read_in_vmap(self):
        assert torch.func.vmap(focal_length)(torch.stack([K, K.T])).tolist() == [700.0, 700.0]


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
