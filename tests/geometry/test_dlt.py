"""The linear algebra of the design matrix and of matrices (3, 3) against NumPy's decompositions."""

import numpy as np
import pytest
import torch
from kornia.core.exceptions import ShapeError
from scenes import signless, uniform
from torch.autograd import gradcheck, gradgradcheck

from kornia_learnnorm.geometry.dlt import design_matrix, nearest_null_vector, null_vector
from kornia_learnnorm.geometry.matrices import (
    cofactors,
    determinant,
    smallest_right_singular_vector,
    smallest_singular_vectors,
)


def test_shape():
    with pytest.raises(ShapeError):
        design_matrix(torch.rand(8, 2), torch.rand(8, 3))


class TestNullVector:
    @pytest.mark.parametrize("num_points", [8, 9, 40])
    def test_is_the_last_right_singular_vector(self, num_points):
        A, weights = uniform(10, num_points, 9, low=-1), uniform(10, num_points, low=0.1, seed=1)
        for w in (None, weights):  # which have no effect on eight
            h = null_vector(A, w).numpy()
            rooted = A.numpy() if w is None else A.numpy() * np.sqrt(w.numpy())[..., None]
            expected = np.linalg.svd(rooted, full_matrices=True)[2][:, -1]
            np.testing.assert_allclose(h, np.sign((expected * h).sum(-1, keepdims=True)) * expected, atol=1e-11)

    @pytest.mark.parametrize("num_points", [8, 12])
    def test_gradients(self, num_points):
        A = uniform(2, num_points, 9, low=-1).requires_grad_()
        outer = lambda A: signless(null_vector(A).unflatten(-1, (3, 3)))  # noqa: E731
        assert gradcheck(outer, [A])
        assert gradgradcheck(outer, [A[:1].detach().requires_grad_()], fast_mode=True)

    def test_small_values_keep_their_digits(self):
        """Singular values 1 to 1e-9: the square of the condition number would leave nothing of the last ones."""
        rng = np.random.default_rng(0)
        U, V = (np.linalg.qr(rng.normal(size=(5, n, 9)))[0] for n in (12, 9))
        A = torch.from_numpy(U @ np.diag([*[1.0] * 6, 1e-3, 1e-6, 1e-9]) @ V.swapaxes(1, 2))
        h = null_vector(A).numpy()
        np.testing.assert_allclose(h, np.sign((V[..., -1] * h).sum(-1, keepdims=True)) * V[..., -1], atol=1e-8)

    @pytest.mark.parametrize("last", [[1.0, 1.0], [0.0, 0.0]])
    def test_no_gradient_where_the_last_value_is_not_simple(self, last):
        A = torch.eye(12, 9, dtype=torch.float64) * torch.tensor([*[1.0] * 7, *last])
        h = null_vector(A.requires_grad_())
        (gradient,) = torch.autograd.grad(h @ uniform(9), [A])
        assert h.norm().item() == pytest.approx(1)
        assert gradient.isfinite().all()


class TestNearestNullVector:
    @pytest.mark.parametrize(("num_points", "distinct"), [(8, 7), (8, 5), (12, 6), (9, 1)])
    def test_is_the_nearest_in_the_null_space(self, num_points, distinct):
        A = uniform(6, distinct, 9, low=-1)
        sideways = np.array([0.0, 0, 0, 0, 0, 1, 0, -1, 0]) / np.sqrt(2)
        nearest = [sideways - np.linalg.pinv(a) @ (a @ sideways) for a in A.numpy()]
        expected = nearest / np.linalg.norm(nearest, axis=-1, keepdims=True)
        rows = torch.arange(num_points) % distinct
        found = nearest_null_vector(A[:, rows], torch.from_numpy(sideways))
        np.testing.assert_allclose(found, expected, atol=1e-10)


def with_singular_values(values: list[float], number: int = 50) -> torch.Tensor:
    """Return random matrices (number, 3, 3) with these singular values."""
    rng = np.random.default_rng(0)
    U, V = (np.linalg.qr(rng.normal(size=(number, 3, 3)))[0] for _ in range(2))
    return torch.from_numpy(U @ np.diag(values) @ V)


class TestSmallestSingularVectors:
    def test_agree_with_the_decomposition(self):
        for values in [
            *([1, 0.5, 0.1], [1, 1, 0.2], [1, 1e-3, 0], [1, 1e-4, 0.99e-4], [1, 1e-8, 1e-10]),
            *([1e-200, 1e-201, 0], [1e200, 1e199, 1e198]),
        ]:
            A = with_singular_values(values)
            U, s, Vh = np.linalg.svd(A.numpy())
            u, v = smallest_singular_vectors(A)
            error = np.abs(np.stack([(u.numpy() * U[..., 2]).sum(-1), (v.numpy() * Vh[:, 2]).sum(-1)]))
            # Rounding turns the vectors by its size over that of the gap.
            bound = 1e-14 * s[:, 0] / (s[:, 1] - s[:, 2])
            assert (np.sqrt(2 * np.abs(1 - error)) < np.maximum(100 * bound, 1e-7)).all()
            assert torch.equal(v, smallest_right_singular_vector(A)[0])

    @pytest.mark.parametrize("values", [[1, 0.3, 0.3], [1, 1, 1], [1, 0, 0], [1e-5, 0, 0]])
    def test_minimise_where_not_simple(self, values):
        A = with_singular_values(values)
        v = smallest_right_singular_vector(A.requires_grad_())[0]
        image = torch.linalg.vector_norm(A @ v[..., None], dim=(1, 2))
        assert (image - values[2]).abs().max() < 1e-6 * values[0]
        assert (v.norm(dim=-1) - 1).abs().max() < 1e-14
        (gradient,) = torch.autograd.grad(v @ uniform(3), A, torch.ones(50, dtype=torch.float64))
        assert gradient.isfinite().all()


class TestCofactors:
    def test_transposed_are_determinant_times_inverse(self, dtype):
        A = uniform(20, 3, 3, low=-1, dtype=dtype)
        np.testing.assert_allclose(determinant(A).numpy(), np.linalg.det(A.numpy()), atol=1e-6)
        expected = np.linalg.det(A.numpy())[:, None, None] * np.linalg.inv(A.numpy())
        np.testing.assert_allclose(cofactors(A).mT.numpy(), expected, atol=2e-6 if dtype == torch.float32 else 1e-14)
