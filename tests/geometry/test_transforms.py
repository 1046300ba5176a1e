"""The builders of transforms against NumPy and the matrix exponential."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from scenes import mapped, uniform
from torch.autograd import gradcheck, gradgradcheck

from kornia_learnnorm.geometry.transforms import affine_transform, paper_transform, spd_transform, transform_fundamental


class TestAffineTransform:
    def test_affine_transform(self, dtype):
        linear, origin, points = (
            uniform(5, *shape, dtype=dtype, seed=k) for k, shape in enumerate([(2, 2), (2,), (4, 2)])
        )
        T = affine_transform(linear, origin)
        expected = np.einsum("bij,bnj->bni", linear, points - origin[:, None])
        np.testing.assert_allclose(mapped(T, points), expected, atol=1e-6)
        assert gradcheck(affine_transform, [linear.double().requires_grad_(), origin.double().requires_grad_()])
        assert affine_transform(linear[0], origin[0]).shape == (3, 3)

    @pytest.mark.parametrize(
        ("build", "first", "origin"),
        [
            *((affine_transform, (2, 3), (2,)), (affine_transform, (2, 2), (3,))),
            *((paper_transform, (2, 5), (2, 2)), (paper_transform, (2, 3), (2, 3))),
        ],
    )
    def test_shapes(self, build, first, origin):
        with pytest.raises(ShapeError):
            build(torch.zeros(first), torch.zeros(origin))

    def test_transform_fundamental_by_hand(self):
        F_mat, T1, T2 = (torch.arange(9.0).view(3, 3) + k for k in range(3))
        expected = T2.numpy().T @ F_mat.numpy() @ T1.numpy()
        np.testing.assert_array_equal(transform_fundamental(F_mat, T1, T2).numpy(), expected)


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


def symmetric(a: float, b: float, c: float) -> torch.Tensor:
    return torch.tensor([[a, b], [b, c]], dtype=torch.float64)


# Where the series ends: ((a - c) / 2)^2 + b^2 = 1e-4.
AROUND_THE_THRESHOLD = [[0.3, d, 0.3] for d in (0.0099, 0.01 - 1e-9, 0.01, 0.01 + 1e-9, 0.0101)]


class TestSPDTransform:
    @pytest.mark.parametrize(
        "params",
        [
            *([0, 0, 0], [1e-9, 0, 0], [0, 1e-5, 0], [1, 0.5, -2], [3, 3, 3], [-3, 3, 3], [3, -3, -3]),
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

    @pytest.mark.parametrize("origin", [[], [0.0, 0.0], [0.7, -0.2]])
    def test_is_smooth(self, origin):
        linear = [[0.0, 0.0, 0.0], [1.0, 0.3, -0.5], [0.2, 0.0, 0.2], *AROUND_THE_THRESHOLD]
        params = torch.tensor([values + origin for values in linear], dtype=torch.float64).requires_grad_()
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
