"""The contract of normalisers, the closed-form ones against NumPy and Kornia, and the builders of transforms."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from kornia.geometry.epipolar import normalize_points
from torch.autograd import gradcheck, gradgradcheck
from two_view import SCENES, correspondences, homogeneous, numpy_hartley, numpy_whitening, uniform

from kornia_learnnorm import Hartley, Identity, PerView, ReweightedWhitening, Whitening, paper_transform, spd_transform
from kornia_learnnorm.normalizers import (
    affine_transform,
    check_correspondences,
    inverse_sqrt,
    solve_dtype,
    transform_fundamental,
    weighted_mean,
)

ALL = {
    "identity": Identity(),
    "hartley": Hartley(),
    "whitening": Whitening(),
    "kornia": PerView(normalize_points),
    "reweighted": ReweightedWhitening(),
}


def mapped(T, points) -> np.ndarray:
    """Points after an affine transform."""
    return (homogeneous(np.asarray(points)) @ np.asarray(T).swapaxes(-1, -2))[..., :2]


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


class TestBuildingBlocks:
    def test_affine_transform(self, dtype):
        linear, origin, points = (
            uniform(5, *shape, dtype=dtype, seed=k) for k, shape in enumerate([(2, 2), (2,), (4, 2)])
        )
        T = affine_transform(linear, origin)
        expected = np.einsum("bij,bnj->bni", linear, points - origin[:, None])
        np.testing.assert_allclose(mapped(T, points), expected, atol=1e-6)
        assert gradcheck(affine_transform, [linear.double().requires_grad_(), origin.double().requires_grad_()])
        assert affine_transform(linear[0], origin[0]).shape == (3, 3)

    @pytest.mark.parametrize(("linear", "origin"), [((2, 3), (2,)), ((2, 2), (3,))])
    def test_affine_transform_shape(self, linear, origin):
        with pytest.raises(ShapeError):
            affine_transform(torch.zeros(linear), torch.zeros(origin))

    def test_transform_fundamental_keeps_the_residuals(self):
        F_mat, T1, T2, x1, x2 = (uniform(4, 3, k, low=-1, seed=k) for k in (3, 3, 3, 1, 1))
        after = (T2 @ x2).mT @ F_mat @ (T1 @ x1)
        assert torch.allclose(x2.mT @ transform_fundamental(F_mat, T1, T2) @ x1, after)

    def test_transform_fundamental_by_hand(self):
        F_mat, T1, T2 = (torch.arange(9.0).view(3, 3) + k for k in range(3))
        expected = T2.numpy().T @ F_mat.numpy() @ T1.numpy()
        np.testing.assert_array_equal(transform_fundamental(F_mat, T1, T2).numpy(), expected)

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

    def test_check_correspondences_takes_a_number(self):
        points = torch.rand(2, 5, 2)
        check_correspondences(points, points, torch.ones(2, 5), at_least=5)
        with pytest.raises(ValueError, match="at least 6 correspondences are needed, got 5"):
            check_correspondences(points, points, at_least=6)


class TestPaperTransform:
    def test_is_the_product(self, dtype):
        params, origin = uniform(20, 3, low=-2, high=2, dtype=dtype), uniform(20, 2, low=-9, high=9, dtype=dtype)
        found = paper_transform(params, origin)
        assert found.dtype == dtype
        for (a, b, theta), (u, v), T in zip(params.tolist(), origin.tolist(), found, strict=True):
            scale, shift = np.diag([np.exp(a), np.exp(b), 1]), np.array([[1, 0, -u], [0, 1, -v], [0, 0, 1]])
            c, s = np.cos(theta), np.sin(theta)
            rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            np.testing.assert_allclose(T.numpy(), scale @ rotation @ shift, rtol=1e-5, atol=1e-5)

    def test_zero_is_a_shift(self):
        T = paper_transform(torch.zeros(3), torch.tensor([3.0, -4.0]))
        np.testing.assert_array_equal(T.numpy(), [[1, 0, -3], [0, 1, 4], [0, 0, 1]])

    def test_gradcheck(self):
        origin = uniform(2, 2).requires_grad_()
        for params in (torch.zeros(2, 3).double(), uniform(2, 3, low=-1)):
            assert gradcheck(paper_transform, [params.requires_grad_(), origin])

    def test_shape(self):
        with pytest.raises(ShapeError):
            paper_transform(torch.zeros(2, 5), torch.zeros(2, 2))
        with pytest.raises(ShapeError):
            paper_transform(torch.zeros(2, 3), torch.zeros(2, 3))


def symmetric(a: float, b: float, c: float) -> torch.Tensor:
    return torch.tensor([[a, b], [b, c]], dtype=torch.float64)


# Where the series ends: ((a - c) / 2)^2 + b^2 = 1e-4.
AROUND_THE_THRESHOLD = [[0.3, d, 0.3] for d in (0.0099, 0.01 - 1e-9, 0.01, 0.01 + 1e-9, 0.0101)]


class TestSPDTransform:
    @pytest.mark.parametrize(
        "params",
        [
            [0, 0, 0],
            [1e-9, 0, 0],
            [0, 1e-5, 0],
            [1, 0.5, -2],
            [3, 3, 3],
            [-3, 3, 3],
            [3, -3, -3],
            *AROUND_THE_THRESHOLD,
        ],
    )
    def test_linear_part_is_the_matrix_exponential(self, params):
        T = spd_transform(torch.tensor(params, dtype=torch.float64))
        expected = torch.linalg.matrix_exp(symmetric(*params))
        assert torch.allclose(T[:2, :2], expected, rtol=1e-12, atol=1e-13)
        np.testing.assert_array_equal(T.numpy()[:, 2], [0, 0, 1])
        np.testing.assert_array_equal(T.numpy()[2], [0, 0, 1])

    @given(st.lists(st.floats(-3, 3), min_size=5, max_size=5))
    def test_five_parameters_move_the_origin_first(self, params):
        S, o = torch.linalg.matrix_exp(symmetric(*params[:3])), torch.tensor(params[3:], dtype=torch.float64)
        T = spd_transform(torch.tensor(params, dtype=torch.float64))
        assert torch.allclose(T[:2, :2], S, rtol=1e-11, atol=1e-12)
        assert torch.allclose(T[:2, 2], -S @ o, rtol=1e-10, atol=1e-10)
        assert (torch.linalg.eigvalsh(T[:2, :2]) > 0).all()

    def test_five_parameters_reach_every_metric(self):
        A = uniform(20, 3, 3, low=-1)
        metric = A.mT @ A + 0.1 * torch.eye(3)
        # Up to scale, [M, -M o; ., o^T M o + 1] with M the square of the linear part.
        for G in metric:
            o = -torch.linalg.solve(G[:2, :2], G[:2, 2])
            M = G[:2, :2] / (G[2, 2] - o @ G[:2, :2] @ o)
            values, vectors = torch.linalg.eigh(M)
            log = vectors @ torch.diag(values.log() / 2) @ vectors.mT
            T = spd_transform(torch.stack([log[0, 0], log[0, 1], log[1, 1], *o]))
            reached = T.mT @ T
            assert torch.allclose(reached / reached.norm(), G / G.norm(), atol=1e-10)

    def test_zero_is_exactly_the_identity(self, dtype, device):
        for number in (3, 5):
            T = spd_transform(torch.zeros(2, number, dtype=dtype, device=device)).cpu()
            assert torch.equal(T, torch.eye(3, dtype=dtype).expand(2, 3, 3))

    @pytest.mark.parametrize("params", [[0.0, 0.0, 0.0], [1.0, 0.3, -0.5], [0.2, 0.0, 0.2], *AROUND_THE_THRESHOLD])
    @pytest.mark.parametrize("origin", [[], [0.0, 0.0], [0.7, -0.2]])
    def test_is_smooth(self, params, origin):
        params = torch.tensor([params + origin], dtype=torch.float64).requires_grad_()
        assert gradcheck(spd_transform, [params])
        assert gradgradcheck(spd_transform, [params])

    def test_batch_shapes(self):
        assert spd_transform(torch.zeros(5)).shape == (3, 3)
        assert spd_transform(torch.zeros(0, 5)).shape == (0, 3, 3)
        assert spd_transform(torch.zeros(2, 4, 3)).shape == (2, 4, 3, 3)

    @pytest.mark.parametrize("number", [0, 2, 4, 6])
    def test_number_of_parameters(self, number):
        with pytest.raises(ValueError, match=rf"3 or 5 parameters a view, got shape \[2, {number}\]"):
            spd_transform(torch.zeros(2, number))
