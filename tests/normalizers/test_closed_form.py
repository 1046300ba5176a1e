"""The contract of normalisers, the closed-form ones against NumPy and Kornia, and the builders of transforms."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.epipolar import normalize_points
from torch.autograd import gradcheck, gradgradcheck
from two_view import SCENES, correspondences, mapped, numpy_hartley, numpy_whitening, uniform

from kornia_learnnorm import Hartley, Identity, PerView, ReweightedWhitening, Whitening
from kornia_learnnorm.geometry.transforms import inverse_sqrt

ALL = {
    "identity": Identity(),
    "hartley": Hartley(),
    "whitening": Whitening(),
    "kornia": PerView(normalize_points),
    "reweighted": ReweightedWhitening(),
}


class TestContract:
    @pytest.mark.parametrize("name", ALL)
    @pytest.mark.parametrize("batch_size", [0, 1, 4])
    @pytest.mark.parametrize("num_points", [8, 30])
    @pytest.mark.parametrize("weighted", [False, True])
    def test_smoke(self, name, batch_size, num_points, weighted, device, dtype):
        points1, points2 = (uniform(batch_size, num_points, 2, high=600, seed=k).to(device, dtype) for k in (0, 1))
        weights = uniform(batch_size, num_points, low=0.1, seed=2).to(device, dtype) if weighted else None
        for T in ALL[name](points1, points2, weights):
            assert T.shape == (batch_size, 3, 3)
            assert T.dtype == dtype
            assert T.device.type == device.type
            assert torch.isfinite(T).all()
            assert torch.equal(T[:, 2].cpu(), torch.tensor([[0, 0, 1]], dtype=dtype).expand(batch_size, 3))  # affine

    @pytest.mark.parametrize("name", ALL)
    def test_swapped_views_give_swapped_transforms(self, name):
        points1, points2 = correspondences("driving", 10, 12)
        weights = uniform(10, 12, low=0.1)
        T1, T2 = ALL[name](points1, points2, weights)
        for expected, found in zip((T2, T1), ALL[name](points2, points1, weights), strict=True):
            assert torch.allclose(found, expected, rtol=1e-8, atol=1e-9)

    @pytest.mark.parametrize("name", ["hartley", "whitening", "kornia"])
    def test_zero_weight_is_absence(self, name):
        points1, points2 = correspondences("handheld", 10, 9)
        weights = uniform(10, 9, low=0.1)
        junk = uniform(10, 3, 2, low=-1e4, high=1e4)
        expected = ALL[name](points1, points2, weights)
        extended = (
            torch.cat([points1, junk], 1),
            torch.cat([points2, -junk], 1),
            torch.cat([weights, junk[..., 0] * 0], 1),
        )
        for found, want in zip(ALL[name](*extended), expected, strict=True):
            assert torch.allclose(found, want, rtol=1e-12, atol=1e-12)

    @pytest.mark.parametrize("name", ["hartley", "whitening"])
    def test_weights_that_are_all_zero_are_equal_weights(self, name):
        points1, points2 = correspondences("handheld", 10, 9)
        zeros = torch.zeros(10, 9, dtype=torch.float64)
        for found, want in zip(ALL[name](points1, points2, zeros), ALL[name](points1, points2), strict=True):
            assert torch.allclose(found, want, rtol=1e-12)

    @pytest.mark.parametrize("name", ALL)
    def test_has_no_state(self, name):
        assert not list(copy.deepcopy(ALL[name]).state_dict())

    @pytest.mark.parametrize("name", ["hartley", "whitening"])
    @pytest.mark.parametrize("num_points", [8, 9, 100])
    @pytest.mark.parametrize("value", [0.0, 5.0, 320.1, 1e6 / 3])
    @pytest.mark.parametrize("weighted", [False, True])
    def test_coincident_points_keep_their_scale(self, name, num_points, value, weighted, dtype):
        points = torch.full((1, num_points, 2), value, dtype=dtype)  # of which no sum need be exact
        weights = 10 ** uniform(1, num_points, low=-6, high=6, dtype=dtype) if weighted else None
        for T in ALL[name](points, points, weights):
            np.testing.assert_allclose(T[0].numpy(), [[1, 0, -value], [0, 1, -value], [0, 0, 1]], rtol=1e-5)

    @pytest.mark.parametrize("name", ["hartley", "whitening"])
    @pytest.mark.parametrize("kind", ["coincident", "horizontal", "diagonal", "two places"])
    def test_degenerate_points(self, name, kind, dtype):
        t = uniform(4, 9, 1, dtype=dtype)
        points = {
            "coincident": torch.full((4, 9, 2), 320.0, dtype=dtype),
            "horizontal": 600 * torch.cat([t, torch.zeros_like(t)], -1),
            "diagonal": 600 * torch.cat([t, 0.3 * t], -1) + 17,
            "two places": 600 * (t > 0.5).to(dtype).expand(-1, -1, 2),
        }[kind]
        points, weights = points.clone().requires_grad_(), uniform(4, 9, dtype=dtype).requires_grad_()
        T1, T2 = ALL[name](points, points, weights)
        gradients = torch.autograd.grad((T1 * uniform(3, 3, dtype=dtype)).sum() + T2.sum(), [points, weights])
        for value in (T1, T2, *gradients):
            assert torch.isfinite(value).all()


class TestIdentity:
    def test_is_the_identity(self, device, dtype):
        for T in Identity()(*(uniform(2, 8, 2, seed=k).to(device, dtype) for k in (0, 1))):
            assert torch.equal(T.cpu(), torch.eye(3, dtype=dtype).expand(2, 3, 3))


class TestHartley:
    @pytest.mark.parametrize("name", SCENES)
    @pytest.mark.parametrize("num_points", [8, 50])
    @pytest.mark.parametrize("weighted", [False, True])
    def test_agrees_with_kornia_and_numpy(self, name, num_points, weighted, device):
        points = correspondences(name, 20, num_points)
        weights = uniform(20, num_points) if weighted else None
        found = Hartley()(*(p.to(device) for p in points), None if weights is None else weights.to(device))
        for p, T in zip(points, found, strict=True):
            np.testing.assert_allclose(T.cpu().numpy(), numpy_hartley(p, weights), rtol=1e-12, atol=1e-12)
            # Kornia adds 1e-8 to the mean distance.
            np.testing.assert_allclose(T.cpu().numpy(), normalize_points(p, weights=weights)[1].numpy(), rtol=1e-8)

    def test_centroid_and_mean_distance(self):
        points1, points2 = correspondences("driving", 20, 8)
        for points, T in zip((points1, points2), Hartley()(points1, points2), strict=True):
            x = mapped(T, points)
            np.testing.assert_allclose(x.mean(1), 0, atol=1e-12)
            np.testing.assert_allclose(np.hypot(*x.T).T.mean(1), np.sqrt(2), rtol=1e-12)

    def test_by_hand(self, dtype):
        # Weights 3, 1, 0: centroid (1, 0), distances 1 and 3, weighted mean 3/2.
        points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [9.0, 9.0]]], dtype=dtype)
        T = Hartley()(points, points, torch.tensor([[3.0, 1.0, 0.0]], dtype=dtype))[0]
        s = np.sqrt(2) / 1.5
        np.testing.assert_allclose(T[0].numpy(), [[s, 0, -s], [0, s, 0], [0, 0, 1]], rtol=1e-6, atol=1e-7)

    def test_gradcheck(self):
        values = [uniform(2, 5, 2, low=-1), uniform(2, 5, 2, low=-1, seed=1), uniform(2, 5, low=0.1, seed=2)]
        assert gradcheck(Hartley(), [v.requires_grad_() for v in values])


class TestWhitening:
    @pytest.mark.parametrize("name", SCENES)
    @pytest.mark.parametrize("num_points", [8, 50])
    @pytest.mark.parametrize("weighted", [False, True])
    def test_agrees_with_numpy(self, name, num_points, weighted, device):
        points = correspondences(name, 20, num_points)
        weights = uniform(20, num_points) if weighted else None
        found = Whitening()(*(p.to(device) for p in points), None if weights is None else weights.to(device))
        for p, T in zip(points, found, strict=True):
            np.testing.assert_allclose(T.cpu().numpy(), numpy_whitening(p, weights), rtol=1e-9, atol=1e-10)

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

    def test_float32_is_solved_in_float64(self):
        points1, points2 = (p.float() + 1e4 for p in correspondences("handheld", 20, 8))  # far from the origin
        single, double = Whitening()(points1, points2)[0], Whitening()(points1.double(), points2.double())[0]
        assert single.dtype == torch.float32
        assert torch.equal(single, double.float())

    @pytest.mark.parametrize("floor", [1e-6, 1e-3])
    def test_floor_of_collinear_points(self, floor):
        # Variance 2/3 * 9 = 6 along x and none along y: eigenvalues 6 (1 + floor) and 6 floor.
        points = torch.tensor([[[-3.0, 0.0], [0.0, 0.0], [3.0, 0.0]]], dtype=torch.float64)
        linear = Whitening(floor)(points, points)[0][0, :2, :2]
        expected = np.diag([(6 * (1 + floor)) ** -0.5, (6 * floor) ** -0.5])
        np.testing.assert_allclose(linear.numpy(), expected, rtol=1e-9)

    def test_gradcheck(self):
        values = [uniform(2, 5, 2, low=-1), uniform(2, 5, 2, low=-1, seed=1), uniform(2, 5, low=0.1, seed=2)]
        values = [v.requires_grad_() for v in values]
        assert gradcheck(Whitening(), values)
        assert gradgradcheck(Whitening(), values)

    def test_gradients_where_the_variances_are_equal(self):
        square = torch.tensor([[[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]]], dtype=torch.float64)
        assert gradcheck(lambda p: Whitening()(p, square)[0], [square.clone().requires_grad_()])

    def test_gradient_of_nearly_equal_variances(self):
        for step in (1e-3, 1e-6, 1e-9, 1e-15):
            covariance = torch.tensor([[1 + step, step], [step, 1]], dtype=torch.float64).requires_grad_()
            (gradient,) = torch.autograd.grad((inverse_sqrt(covariance) * uniform(2, 2)).sum(), [covariance])
            assert gradient.abs().max() < 2  # half of the weights at most, and no division by the gap

    @pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
    def test_inverse_sqrt(self, scale):
        A = uniform(50, 2, 2, low=-1)
        covariance = scale * (A @ A.mT + 1e-3 * torch.eye(2))
        root = inverse_sqrt(covariance)
        np.testing.assert_allclose((root @ covariance @ root).numpy(), np.tile(np.eye(2), (50, 1, 1)), atol=1e-8)
        assert torch.equal(inverse_sqrt(torch.zeros(2, 2)), torch.eye(2))


class TestPerView:
    def test_passes_weights_only_where_there_are_any(self):
        calls = []

        def normalize(points, **kwargs):
            calls.append((points, kwargs))
            return None, torch.eye(3).expand(len(points), 3, 3)

        points1, points2, weights = torch.rand(2, 8, 2), torch.rand(2, 8, 2), torch.rand(2, 8)
        PerView(normalize)(points1, points2)
        PerView(normalize)(points1, points2, weights)
        assert [points for points, _ in calls] == [points1, points2, points1, points2]
        assert [list(kwargs) for _, kwargs in calls] == [[], [], ["weights"], ["weights"]]
        assert calls[2][1]["weights"] is weights

    def test_is_the_callable_of_each_view(self):
        points1, points2 = correspondences("handheld", 3, 10)
        for weights in (None, uniform(3, 10)):
            T1, T2 = PerView(normalize_points)(points1, points2, weights)
            assert torch.equal(T1, normalize_points(points1, weights=weights)[1])
            assert torch.equal(T2, normalize_points(points2, weights=weights)[1])
