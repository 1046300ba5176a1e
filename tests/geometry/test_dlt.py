"""The linear problem, its design matrix and matrices (3, 3), against NumPy's decompositions."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from references import null_matrices, signless, up_to_sign
from scenes import correspondences, uniform
from torch.autograd import gradcheck, gradgradcheck

from kornia_learnnorm import Whitening, find_fundamental
from kornia_learnnorm.geometry import matrices
from kornia_learnnorm.geometry.dlt import design_matrix, nearest_null_vector, solve_rows
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import affine_transform
from kornia_learnnorm.models.fundamental import Fundamental


def test_shape():
    with pytest.raises(ShapeError):
        design_matrix(torch.rand(8, 2), torch.rand(8, 3))


class TestNullVector:
    @pytest.mark.parametrize("num_points", [8, 9, 40])
    def test_is_the_last_right_singular_vector(self, num_points):
        A, weights = uniform(10, num_points, 9, low=-1), uniform(10, num_points, low=0.1, seed=1)
        for w in (None, weights):  # which have no effect on eight
            h = solve_rows(A, w)[0].numpy()
            rooted = A.numpy() if w is None else A.numpy() * np.sqrt(w.numpy())[..., None]
            expected = np.linalg.svd(rooted, full_matrices=True)[2][:, -1]
            np.testing.assert_allclose(h, np.sign((expected * h).sum(-1, keepdims=True)) * expected, atol=1e-11)

    @pytest.mark.parametrize("num_points", [8, 12])
    def test_gradients(self, num_points):
        A = uniform(2, num_points, 9, low=-1).requires_grad_()
        outer = lambda A: signless(solve_rows(A)[0].unflatten(-1, (3, 3)))  # noqa: E731
        assert gradcheck(outer, [A])
        assert gradgradcheck(outer, [A[:1].detach().requires_grad_()], fast_mode=True)

    def test_small_values_keep_their_digits(self):
        """Singular values 1 to 1e-9: the square of the condition number would leave nothing of the last ones."""
        rng = np.random.default_rng(0)
        U, V = (np.linalg.qr(rng.normal(size=(5, n, 9)))[0] for n in (12, 9))
        A = torch.from_numpy(U @ np.diag([*[1.0] * 6, 1e-3, 1e-6, 1e-9]) @ V.swapaxes(1, 2))
        h = solve_rows(A)[0].numpy()
        np.testing.assert_allclose(h, np.sign((V[..., -1] * h).sum(-1, keepdims=True)) * V[..., -1], atol=1e-8)

    @pytest.mark.parametrize("last", [[1.0, 1.0], [0.0, 0.0]])
    def test_no_gradient_where_the_last_value_is_not_simple(self, last):
        A = torch.eye(12, 9, dtype=torch.float64) * torch.tensor([*[1.0] * 7, *last])
        h = solve_rows(A.requires_grad_())[0]
        (gradient,) = torch.autograd.grad(h @ uniform(9), [A])
        assert h.norm().item() == pytest.approx(1)
        assert gradient.isfinite().all()


@pytest.mark.parametrize(("num_points", "distinct"), [(8, 7), (8, 5), (12, 6), (9, 1)])
def test_is_the_nearest_in_the_null_space(num_points, distinct):
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
            v, C = matrices.smallest_right_singular_vector(A)
            u = (C @ v[..., None])[..., 0].numpy()
            u = u / np.linalg.norm(u, axis=-1, keepdims=True)
            error = np.abs(np.stack([(u * U[..., 2]).sum(-1), (v.numpy() * Vh[:, 2]).sum(-1)]))
            # Rounding turns the vectors by its size over that of the gap.
            bound = 1e-14 * s[:, 0] / (s[:, 1] - s[:, 2])
            assert (np.sqrt(2 * np.abs(1 - error)) < np.maximum(100 * bound, 1e-7)).all()

    @pytest.mark.parametrize("values", [[1, 0.3, 0.3], [1, 1, 1], [1, 0, 0], [1e-5, 0, 0]])
    def test_minimise_where_not_simple(self, values):
        A = with_singular_values(values)
        v = matrices.smallest_right_singular_vector(A.requires_grad_())[0]
        image = torch.linalg.vector_norm(A @ v[..., None], dim=(1, 2))
        assert (image - values[2]).abs().max() < 1e-6 * values[0]
        assert (v.norm(dim=-1) - 1).abs().max() < 1e-14
        (gradient,) = torch.autograd.grad(v @ uniform(3), A, torch.ones(50, dtype=torch.float64))
        assert gradient.isfinite().all()


def test_transposed_are_determinant_times_inverse(dtype):
    A = uniform(20, 3, 3, low=-1, dtype=dtype)
    np.testing.assert_allclose(matrices.determinant(A).numpy(), np.linalg.det(A.numpy()), atol=1e-6)
    expected = np.linalg.det(A.numpy())[:, None, None] * np.linalg.inv(A.numpy())
    atol = 2e-6 if dtype == torch.float32 else 1e-14
    np.testing.assert_allclose(matrices.cofactors(A).mT.numpy(), expected, atol=atol)


def problem_of(points1, points2, weights=None):
    return LinearProblem.from_points(points1, points2, weights, Fundamental())


class TestLinearProblem:
    @pytest.mark.parametrize("num_points", [8, 20])
    @given(entries=st.lists(st.floats(-0.5, 0.5), min_size=4, max_size=4), shift=st.floats(-2, 2))
    def test_other_coordinates(self, num_points, entries, shift):
        points = correspondences("handheld", 5, num_points)
        problem = problem_of(*points)
        linear = torch.eye(2, dtype=torch.float64) + torch.tensor(entries, dtype=torch.float64).view(2, 2)
        if torch.linalg.cond(linear) > 10:
            return
        move = affine_transform(linear, torch.full((2,), shift, dtype=torch.float64))
        T1, T2 = move @ problem.T1, move.inverse() @ problem.T2
        assert up_to_sign(problem.solve_in(T1, T2)[0], null_matrices(*points, T1, T2)) < 1e-7

    def test_gap_of_a_noisy_plane(self):
        """A rank test passes a plane with noise; the gap says how little it means."""
        plane = uniform(20, 12, 2, high=500)
        moved = plane @ torch.tensor([[1.1, 0.1], [-0.2, 0.9]], dtype=torch.float64) + 5
        exact, noisy = (problem_of(plane, moved + size * uniform(20, 12, 2, low=-1, seed=1)) for size in (0.0, 0.01))
        scene = problem_of(*correspondences("handheld", 20, 12))
        assert not exact.determined.any()
        assert noisy.determined.all()
        assert noisy.gap.max() < 0.1 * scene.gap.median()

    @pytest.mark.parametrize("num_points", [8, 12])
    @given(seed=st.integers(0, 2**20))
    def test_neither_sign_nor_choice_depend_on_the_order(self, num_points, seed):
        """Of matches in space, and with one twice, for Hartley's and for other coordinates."""
        order = torch.randperm(num_points, generator=torch.Generator().manual_seed(seed))
        for distinct in (7, num_points):
            rows, points = torch.arange(num_points) % distinct, correspondences("handheld", 5, distinct)
            for normalizer in (None, Whitening()):
                views = ([p[:, i] for p in points] for i in (rows, rows[order]))
                F_mat, shuffled = (find_fundamental(*view, normalizer=normalizer) for view in views)
                assert (F_mat - shuffled).abs().max() < 1e-6

    def test_select_and_detach(self):
        points = [p.requires_grad_() for p in correspondences("handheld", 4, 10)]
        problem = problem_of(*points, uniform(4, 10, low=0.1))
        with torch.no_grad():
            assert not problem.null_matrix.requires_grad
        assert problem.null_matrix.requires_grad  # a solution without gradient is not kept
        part = problem.select(torch.tensor([2, 0]))
        assert torch.equal(part.null_matrix, problem.null_matrix[[2, 0]])
        assert torch.equal(part.weights, problem.weights[[2, 0]])
        held = problem.detach(torch.tensor([True, False, False, True]))
        gradient = torch.autograd.grad(signless(held.null_matrix).sum(), points[0])[0]
        assert gradient.flatten(1).any(1).tolist() == [False, True, True, False]


@given(seed=st.integers(0, 2**20), size=st.floats(-1e-13, 1e-13))
def test_sign_under_pure_translation_does_not_depend_on_rounding(seed, size):
    x, y, z = uniform(3, low=-1, seed=seed).tolist()
    F_mat = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    moved = -F_mat + size * uniform(3, 3, low=-1, seed=seed + 1)
    assert (matrices.unit_matrix(F_mat) - matrices.unit_matrix(moved)).abs().max() < 1e-6


def test_equal_views():
    """Eight matches without motion, whose rows are dependent but for rounding (a relative gap of 2e-14)."""
    x = [[68.393906, 466.22247], [413.4204, 457.2358], [183.80737, 463.65524]]
    x += [[386.50964, 465.5876], [389.8796, 462.79868], [384.9661, 468.36307]]
    x += [[50.873444, 16.89095], [40.96122, 43.963448]]
    points = torch.tensor([x], dtype=torch.float32).double().requires_grad_()
    null_matrix = problem_of(points, points).null_matrix
    assert torch.allclose(null_matrix.abs()[0, 1:, 1:].diag().flip(0), torch.zeros(2).double(), atol=1e-9)
    assert float(null_matrix.detach().norm()) == pytest.approx(1)
    assert torch.autograd.grad(null_matrix.sum(), points)[0].isfinite().all()
