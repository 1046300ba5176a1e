"""The linear problem: solved once, carried to other coordinates, and handed down through the layer."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import correspondences, null_matrices, signless, uniform, up_to_sign

from kornia_learnnorm import Whitening, find_fundamental
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.geometry.transforms import affine_transform
from kornia_learnnorm.models.fundamental import Fundamental


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
                F_mat, shuffled = (
                    find_fundamental(*(p[:, i] for p in points), normalizer=normalizer) for i in (rows, rows[order])
                )
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
    assert (unit_matrix(F_mat) - unit_matrix(moved)).abs().max() < 1e-6


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
