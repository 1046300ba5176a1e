"""The checks, the dtype and the averages that all modules share."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.core.exceptions import ShapeError
from two_view import uniform

from kornia_learnnorm.geometry.checks import check_correspondences, solve_dtype, weighted_mean


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

    def test_check_correspondences(self):
        """What it refuses is tested with the estimators and normalisers."""
        points = torch.rand(2, 8, 2)
        check_correspondences(points, points, torch.ones(2, 8))

    def test_errors_name_the_argument(self):
        with pytest.raises(ShapeError, match=r"(?s)Actual shape: \[2, 8, 3\].*points2"):
            check_correspondences(torch.rand(2, 8, 2), torch.rand(2, 8, 3))
        with pytest.raises(TypeError, match=r"got <class 'numpy.ndarray'>; torch.from_numpy\(points1\)"):
            check_correspondences(np.zeros((2, 8, 2)), torch.rand(2, 8, 2))
