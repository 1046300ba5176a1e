"""The closed-form normalisers against NumPy."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.epipolar import normalize_points
from pairwise import pairwise
from scenes import SCENES, correspondences, mapped, numpy_hartley, numpy_whitening, uniform
from torch.autograd import gradcheck

from kornia_learnnorm import Hartley, PerView, Whitening
from kornia_learnnorm.geometry.transforms import inverse_sqrt

CASES = {
    "hartley": (Hartley(), numpy_hartley, 1e-12, 1e-12),
    "whitening": (Whitening(), numpy_whitening, 1e-9, 1e-10),
    "kornia": (PerView(normalize_points), numpy_hartley, 1e-8, 0),  # Kornia adds 1e-8 to the mean distance
}


@pairwise(case=CASES, name=SCENES, num_points=[8, 50], weighted=[False, True])
def test_agrees_with_numpy(case, name, num_points, weighted, device):
    normalizer, reference, rtol, atol = CASES[case]
    points = correspondences(name, 20, num_points)
    weights = uniform(20, num_points) if weighted else None
    found = normalizer(*(p.to(device) for p in points), None if weights is None else weights.to(device))
    for p, T in zip(points, found, strict=True):
        np.testing.assert_allclose(T.cpu().numpy(), reference(p, weights), rtol=rtol, atol=atol)


class TestWhitening:
    @given(st.integers(0, 2**31), st.sampled_from([8, 40]), st.floats(-6, 6), st.sampled_from(["random", "driving"]))
    def test_covariance_becomes_the_identity(self, seed, num_points, log_scale, name):
        points1, points2 = (10**log_scale * p for p in correspondences(name, 5, num_points, seed))
        weights = uniform(5, num_points, low=0.05, seed=seed)
        for points, T in zip((points1, points2), Whitening()(points1, points2, weights), strict=True):
            for x, w, linear in zip(mapped(T, points), weights.numpy(), T[:, :2, :2], strict=True):
                assert np.average(x, axis=0, weights=w) == pytest.approx(0, abs=1e-7)
                np.testing.assert_allclose(np.cov(x.T, aweights=w, ddof=0), np.eye(2), atol=1e-5)
                assert torch.allclose(linear, linear.mT)  # symmetric: no rotation of its own
                assert (torch.linalg.eigvalsh(linear) > 0).all()

    @pytest.mark.parametrize("floor", [1e-6, 1e-3])
    def test_floor_of_collinear_points(self, floor):
        # Variance 2/3 * 9 = 6 along x and none along y: eigenvalues 6 (1 + floor) and 6 floor.
        points = torch.tensor([[[-3.0, 0.0], [0.0, 0.0], [3.0, 0.0]]], dtype=torch.float64)
        linear = Whitening(floor)(points, points)[0][0, :2, :2]
        expected = np.diag([(6 * (1 + floor)) ** -0.5, (6 * floor) ** -0.5])
        np.testing.assert_allclose(linear.numpy(), expected, rtol=1e-9)

    def test_gradients_where_the_variances_are_equal(self):
        square = torch.tensor([[[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]]], dtype=torch.float64)
        assert gradcheck(lambda p: Whitening()(p, square)[0], [square.clone().requires_grad_()])

    def test_gradient_of_nearly_equal_variances(self):
        for step in (1e-3, 1e-6, 1e-9, 1e-15):
            covariance = torch.tensor([[1 + step, step], [step, 1]], dtype=torch.float64).requires_grad_()
            (gradient,) = torch.autograd.grad((inverse_sqrt(covariance) * uniform(2, 2)).sum(), [covariance])
            assert gradient.abs().max() < 2  # half of the weights at most, and no division by the gap
