"""Closed forms of matrices of three rows and columns against NumPy's decompositions."""

import numpy as np
import pytest
import torch
from scenes import uniform

from kornia_learnnorm.geometry.matrices import (
    cofactors,
    determinant,
    smallest_right_singular_vector,
    smallest_singular_vectors,
)


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
