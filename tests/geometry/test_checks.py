"""The checks, the dtype and the averages that all modules share."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.core.exceptions import ShapeError
from scenes import uniform

from kornia_learnnorm.geometry.checks import check_cameras, check_correspondences, solve_dtype, weighted_mean

K = torch.tensor([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]])


class TestCameras:
    @pytest.mark.parametrize("scale", [1.0, -2.0, 1e-3])
    def test_any_scale(self, scale):
        check_cameras(scale * K, K.expand(4, 3, 3), 4)

    def test_transposed(self):
        """The error names the camera and its last row, also of a single one in a batch."""
        with pytest.raises(ValueError, match=r"^K1 .*320 240 1.*transposed"):
            check_cameras(K.T, K)
        with pytest.raises(ValueError, match=r"^K2 .*320 240 1.*transposed"):
            check_cameras(K, torch.stack([K, K.T]).requires_grad_(), 2)

    def test_values_are_not_read_in_transforms(self):
        def focal_length(camera):
            check_cameras(camera, camera)
            return camera[0, 0]

        assert torch.func.vmap(focal_length)(torch.stack([K, K.T])).tolist() == [700.0, 700.0]
        assert torch.compile(focal_length, backend="eager", fullgraph=True)(K.T) == 700.0


class TestCorrespondences:
    def test_weighted_mean(self):
        values, weights = uniform(3, 6, 2), uniform(3, 6, seed=1)
        expected = [np.average(v, axis=0, weights=w) for v, w in zip(values, weights, strict=True)]
        np.testing.assert_allclose(weighted_mean(values, weights).numpy(), expected)
        np.testing.assert_allclose(weighted_mean(values, None).numpy(), values.numpy().mean(1))
        np.testing.assert_allclose(weighted_mean(values, 0 * weights).numpy(), values.numpy().mean(1))

    def test_solve_dtype(self):
        assert solve_dtype(torch.device("cpu")) == torch.float64
        assert solve_dtype(torch.device("cuda:0")) == torch.float64
        assert solve_dtype(torch.device("mps")) == torch.float32

    def test_errors_name_the_argument(self):
        """What else is refused is tested with the estimators and normalisers."""
        with pytest.raises(ShapeError, match=r"(?s)\[2, 8, 3\].*points2"):
            check_correspondences(torch.rand(2, 8, 2), torch.rand(2, 8, 3))
        with pytest.raises(TypeError, match=r"numpy.ndarray.*torch.from_numpy\(points1\)"):
            check_correspondences(np.zeros((2, 8, 2)), torch.rand(2, 8, 2))
