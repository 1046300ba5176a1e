"""The builders of transforms against NumPy and the matrix exponential."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from references import mapped
from scenes import raises, uniform
from torch.autograd import gradcheck, gradgradcheck

from kornia_learnnorm.geometry.transforms import affine_transform, paper_transform, spd_transform


def test_affine_transform(dtype):
    linear, origin, points = (uniform(5, *shape, dtype=dtype) for shape in [(2, 2), (2,), (4, 2)])
    T = affine_transform(linear, origin)
    expected = np.einsum("bij,bnj->bni", linear, points - origin[:, None])
    np.testing.assert_allclose(mapped(T, points), expected, atol=1e-6)
    assert gradcheck(affine_transform, [linear.double().requires_grad_(), origin.double().requires_grad_()])
    assert affine_transform(linear[0], origin[0]).shape == (3, 3)


class TestPaperTransform:
    def test_is_the_product(self, dtype):
        params = uniform(20, 3, low=-2, high=2, dtype=dtype)
        found = paper_transform(params)
        assert found.dtype == dtype
        for (a, b, theta), T in zip(params.tolist(), found, strict=True):
            c, s = np.cos(theta), np.sin(theta)
            rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            np.testing.assert_allclose(T.numpy(), np.diag([np.exp(a), np.exp(b), 1]) @ rotation, rtol=1e-5, atol=1e-5)

    def test_gradcheck(self):
        for params in (torch.zeros(2, 3).double(), uniform(2, 3, low=-1)):
            assert gradcheck(paper_transform, params.requires_grad_())


def symmetric(a: float, b: float, c: float) -> torch.Tensor:
    return torch.tensor([[a, b], [b, c]], dtype=torch.float64)


# Where the series ends: ((a - c) / 2)^2 + b^2 = 1e-4.
AROUND_THE_THRESHOLD = [[0.3, d, 0.3] for d in (0.0099, 0.01 - 1e-9, 0.01, 0.01 + 1e-9, 0.0101)]


class TestSPDTransform:
    def test_linear_part_is_the_matrix_exponential(self):
        for params in [
            *([0, 0, 0], [1e-9, 0, 0], [0, 1e-5, 0], [1, 0.5, -2], [3, 3, 3], [-3, 3, 3], [3, -3, -3]),
            *AROUND_THE_THRESHOLD,
        ]:
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

    @pytest.mark.parametrize("shape", [(3,), (5,), (0, 5), (2, 4, 3)])
    def test_zero_is_exactly_the_identity(self, shape, dtype, device):
        T = spd_transform(torch.zeros(shape, dtype=dtype, device=device)).cpu()
        assert torch.equal(T, torch.eye(3, dtype=dtype).expand(*shape[:-1], 3, 3))

    @pytest.mark.parametrize("origin", [[], [0.7, -0.2]])
    def test_is_smooth(self, origin):
        linear = [[0.0, 0.0, 0.0], [1.0, 0.3, -0.5], [0.2, 0.0, 0.2], *AROUND_THE_THRESHOLD]
        params = torch.tensor([values + origin for values in linear], dtype=torch.float64).requires_grad_()
        assert gradcheck(spd_transform, [params])
        assert gradgradcheck(spd_transform, [params], fast_mode=True)


def test_wrong_shapes():
    for function, shapes, message in [
        (affine_transform, [(2, 3), (2,)], r"\[2, 3\]"),
        (affine_transform, [(2, 2), (3,)], r"\[3\]"),
        (paper_transform, [(2, 5)], r"\[2, 5\]"),
        *((spd_transform, [(2, n)], rf"3 or 5 parameters a view, got shape \[2, {n}\]") for n in (0, 2, 4, 6)),
    ]:
        raises((ShapeError, ValueError), message, function, *map(torch.zeros, shapes))
