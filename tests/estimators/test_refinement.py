"""Levenberg-Marquardt against Gauss-Newton in NumPy on numerical derivatives, and the properties it must have."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pairwise import pairwise
from scenes import (
    SCENES,
    correspondences,
    epipolar_distances,
    hartley_difference,
    in_hartley,
    least_squares,
    numpy_hartley,
    numpy_sampson,
    scenes,
    signless,
    uniform,
    unit,
    up_to_sign,
)
from torch.autograd import gradcheck

from kornia_learnnorm import find_fundamental, sampson_distance, symmetric_epipolar_distance
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import (
    Cauchy,
    GemanMcClure,
    Huber,
    Truncated,
    squared_loss,
)

DISTANCES = {"sampson": sampson_distance, "symmetric": symmetric_epipolar_distance}
LOSSES = [squared_loss, Huber(0.5), Cauchy(0.5), GemanMcClure(2.0), Truncated(3.0)]


def numpy_distances(F, points1, points2, kind: str) -> np.ndarray:
    """Distances in pixels, (N,), of which those of Sampson have signs."""
    return numpy_sampson(points1, points2, F) if kind == "sampson" else epipolar_distances(points1, points2, F)


def gauss_newton(F, points1, points2, kind: str) -> float:
    """Least cost found from F, as F = [a b a*s + b*t] (epipole by two ratios)."""
    T1, T2 = (numpy_hartley(p[None])[0] for p in (points1, points2))
    F = unit(np.linalg.inv(T2).T @ F @ np.linalg.inv(T1))
    # Turn the epipole of view 1 to the third axis, where the last column of F vanishes and the chart is centred.
    V = np.linalg.svd(F)[2].T

    def distances(q):
        columns = np.column_stack([q[:6].reshape(3, 2), q[:6].reshape(3, 2) @ q[6:]])
        return numpy_distances(T2.T @ columns @ V.T @ T1, points1, points2, kind)

    return least_squares(distances, np.concatenate([(F @ V)[:, :2].reshape(6), np.zeros(2)]))


class TestRefineFundamental:
    @pytest.mark.parametrize("batch_size", [0, 1, 5])
    def test_what_it_returns_beside_the_matrix(self, batch_size, device, dtype):
        points = [uniform(batch_size, 20, 2, high=600, seed=k).to(device, dtype) for k in (0, 1)]
        found = refine_fundamental(*points, uniform(batch_size, 3, 3).to(device), max_iterations=5)
        assert [value.dtype for value in found] == [dtype, dtype, dtype, torch.int64, torch.bool]
        assert all(value.shape == (batch_size,) and value.device.type == device.type for value in found[1:])

    @pairwise(name=["driving", "handheld", "orbit"], kind=DISTANCES, num_points=[12, 40])
    def test_agrees_with_numpy(self, name, kind, num_points):
        points1, points2 = correspondences(name, 3, num_points, noise=0.5)
        F0 = find_fundamental(points1, points2)
        found = refine_fundamental(points1, points2, F0, distance=kind, max_iterations=200)
        arguments = zip(F0.numpy(), points1.numpy(), points2.numpy(), strict=True)
        expected = [gauss_newton(*values, kind) for values in arguments]
        assert found.converged.all()
        assert found.cost.numpy() == pytest.approx(expected, rel=1e-6)

    @pytest.mark.parametrize("kind", DISTANCES)
    @pytest.mark.parametrize("loss", LOSSES)
    def test_costs_are_those_of_the_matrices(self, kind, loss):
        points1, points2 = correspondences("handheld", 10, 15)
        weights, F0 = uniform(10, 15), find_fundamental(points1, points2)
        found = refine_fundamental(points1, points2, F0, weights, kind, loss)
        for F_mat, cost in ((F0, found.cost_before), (found.F_mat, found.cost)):
            expected = (weights * loss(DISTANCES[kind](points1, points2, F_mat).square())[0]).sum(-1)
            np.testing.assert_allclose(cost.numpy(), expected.numpy(), rtol=1e-8)

    @pytest.mark.parametrize("kind", DISTANCES)
    @pytest.mark.parametrize("loss", LOSSES)
    def test_nothing_near_the_optimum_costs_less(self, kind, loss):
        points1, points2 = correspondences("orbit", 10, 30, noise=0.5)
        found = refine_fundamental(points1, points2, find_fundamental(points1, points2), None, kind, loss, 300)
        assert found.converged.all()
        T1, T2 = (torch.from_numpy(numpy_hartley(points)) for points in (points1, points2))
        F_hat = torch.from_numpy(in_hartley(found.F_mat, points1, points2))
        for seed in range(5):
            near = T2.mT @ (F_hat + 1e-3 * uniform(10, 3, 3, low=-1, seed=seed)) @ T1
            cost = refine_fundamental(points1, points2, near, None, kind, loss, 0).cost
            assert (cost > found.cost * (1 - 1e-9)).all()

    @pytest.mark.parametrize("kind", DISTANCES)
    @pytest.mark.parametrize("num_points", [8, 20])
    def test_exact_points(self, kind, num_points):
        scene = scenes("orbit", 20, num_points, noise=0.0)
        T1, T2 = (torch.from_numpy(numpy_hartley(points)) for points in scene[:2])
        F_hat = torch.from_numpy(in_hartley(scene.F_mat, *scene[:2]))
        for F0 in (scene.F_mat, T2.mT @ (F_hat + 1e-4 * uniform(20, 3, 3, low=-1)) @ T1):
            found = refine_fundamental(*scene[:2], F0, distance=kind, max_iterations=200)
            assert found.converged.all()
            assert (found.cost < 1e-16).all()

    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_robust_losses_see_past_outliers(self, loss):
        scene = scenes("orbit", 20, 60, noise=0.2, outliers=0.1)
        F0 = find_fundamental(scene.points1, scene.points2, torch.where(scene.inliers, 1.0, 1e-9))
        squares, robust = (refine_fundamental(scene.points1, scene.points2, F0, loss=x) for x in (squared_loss, loss))
        errors = [
            np.median(epipolar_distances(scene.points1, scene.points2, found.F_mat)[scene.inliers.numpy()])
            for found in (squares, robust)
        ]
        assert errors[1] < 0.5 * errors[0]

    @given(
        st.integers(0, 2**31),
        st.sampled_from([8, 9, 30]),
        st.sampled_from(sorted(SCENES)),
        st.sampled_from(sorted(DISTANCES)),
        st.sampled_from(LOSSES),
        st.integers(0, 12),
    )
    def test_cost_never_rises_and_rank_two_holds(self, seed, num_points, name, kind, loss, max_iterations):
        points1, points2 = correspondences(name, 5, num_points, seed)
        F0 = find_fundamental(points1, points2)
        found = refine_fundamental(points1, points2, F0, None, kind, loss, max_iterations)
        assert (found.cost <= found.cost_before).all()
        assert (found.iterations <= max_iterations).all()
        assert np.linalg.norm(found.F_mat.numpy(), axis=(1, 2)) == pytest.approx(1, abs=1e-14)
        for F in (found.F_mat.numpy(), in_hartley(found.F_mat, points1, points2)):
            assert (np.linalg.svd(F)[1][:, 2] < 1e-12).all()

    @pytest.mark.parametrize("num_points", [20, 3000])  # as one part and as several
    @pytest.mark.parametrize("weighted", [False, True])
    def test_matrices_may_share_points(self, num_points, weighted):
        points = correspondences("handheld", 1, num_points, noise=0.5)
        weights = uniform(1, num_points, low=0.1) if weighted else None
        F0 = find_fundamental(*(p[:, :16].view(2, 8, 2) for p in points)).repeat(6, 1, 1)
        many = [None if value is None else value.expand(12, *value.shape[1:]) for value in (*points, weights)]
        shared = refine_fundamental(*points, F0, weights, loss=Cauchy(1.0), max_iterations=8)
        copied = refine_fundamental(*many[:2], F0, many[2], loss=Cauchy(1.0), max_iterations=8)
        assert hartley_difference(shared.F_mat, copied.F_mat, *many[:2]) < 1e-7
        assert torch.equal(shared.iterations, copied.iterations)

    def test_shared_points_take_the_gradients_of_all(self):
        points = correspondences("orbit", 1, 14, noise=1.0)
        F0 = find_fundamental(*points).repeat(3, 1, 1)
        gradients = []
        for count in (1, 3):
            values = [value.repeat(count, 1, 1).requires_grad_() for value in points]
            found = refine_fundamental(*values, F0, max_iterations=60)
            assert found.converged.all()
            gradients.append([g.sum(0) for g in torch.autograd.grad(signless(found.F_mat).sum(), values)])
        for one, many in zip(*gradients, strict=True):
            torch.testing.assert_close(one, many, rtol=1e-4, atol=1e-8)

    @pytest.mark.parametrize("loss", [squared_loss, Cauchy(0.5)])
    def test_tolerance_trades_steps_for_cost(self, loss):
        points1, points2 = correspondences("driving", 20, 100, noise=0.5)
        F0 = find_fundamental(points1, points2)
        loose, tight = (refine_fundamental(points1, points2, F0, loss=loss, tolerance=t) for t in (1e-3, 1e-7))
        assert loose.converged.all()
        assert (loose.iterations <= tight.iterations).all()
        assert loose.iterations.sum() < 0.5 * tight.iterations.sum()
        assert (loose.cost <= tight.cost * 1.002).double().mean() > 0.9

    def test_returns_the_start_where_no_step_is_possible(self):
        points1, points2 = correspondences("handheld", 5, 12)
        F0 = find_fundamental(points1, points2)

        def broken(squares):
            return squares, torch.full_like(squares, torch.nan)

        found = refine_fundamental(points1, points2, F0, loss=broken)
        assert up_to_sign(found.F_mat, F0) < 1e-12
        assert torch.equal(found.cost, found.cost_before)
        assert not found.converged.any()


class TestGradients:
    @pytest.mark.parametrize("kind", DISTANCES)
    @pytest.mark.parametrize("loss", [squared_loss, Cauchy(0.3)])
    def test_at_the_optimum(self, kind, loss):
        scene = scenes("orbit", 1, 14, noise=1.0)
        points = [(points / 300 - 1).requires_grad_() for points in scene[:2]]
        F0 = find_fundamental(*points).detach()
        optimum = refine_fundamental(*points, F0, distance=kind, loss=loss, max_iterations=500)
        assert optimum.converged.all()
        start = optimum.F_mat.detach()
        weights = uniform(1, 14, low=0.9, high=1.1, seed=3).requires_grad_()

        def refined(points1, points2, weights):
            return signless(refine_fundamental(points1, points2, start, weights, kind, loss, 500).F_mat)

        # A central difference of the iteration stops within 1e-7 of the gradient's zero.
        assert gradcheck(refined, [*points, weights], eps=1e-5, atol=1e-3, rtol=1e-3, fast_mode=True)

    def test_without_gradients_the_result_is_the_same(self):
        points1, points2 = correspondences("orbit", 5, 12)
        F0 = find_fundamental(points1, points2).requires_grad_()
        plain = refine_fundamental(points1, points2, F0)
        tracked = refine_fundamental(points1.requires_grad_(), points2, F0)
        assert not plain.F_mat.requires_grad  # the start sends none
        assert up_to_sign(plain.F_mat, tracked.F_mat.detach()) < 1e-12
        assert not tracked.cost.requires_grad

    def test_none_where_it_did_not_converge(self):
        points1, points2 = (points.requires_grad_() for points in correspondences("driving", 5, 8))
        found = refine_fundamental(points1, points2, find_fundamental(points1, points2).detach(), max_iterations=1)
        (gradient,) = torch.autograd.grad(signless(found.F_mat).sum(), points1)
        assert not found.converged.any()
        assert (gradient == 0).all()


class TestObjectives:
    @pytest.mark.parametrize("loss", LOSSES)
    def test_weights_of_losses(self, loss):
        squares = uniform(50, high=20).requires_grad_()
        value, weight = loss(squares)
        torch.testing.assert_close(weight.detach(), torch.autograd.grad(value.sum(), squares)[0])
        assert loss(torch.zeros(1))[0] == 0
        assert loss(torch.zeros(1))[1] == 1

    @pytest.mark.parametrize("kind", [Huber, Cauchy, GemanMcClure, Truncated])
    @pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
    def test_scale_must_be_positive(self, kind, scale):
        with pytest.raises(ValueError, match=f"scale must be positive, got {scale}"):
            kind(scale)
        with pytest.raises(TypeError, match="scale must be a number of pixels, got '1'"):
            kind("1")


@pytest.mark.parametrize(
    ("option", "error", "message"),
    [
        ({"loss": "huber"}, TypeError, "loss must be a function or an instance .* got 'huber'"),
        ({"max_iterations": 2.5}, TypeError, "max_iterations must be a whole number, got 2.5"),
        ({"max_iterations": -1}, ValueError, "max_iterations and tolerance must be >= 0, got -1 and 1e-07"),
        ({"tolerance": -0.5}, ValueError, "max_iterations and tolerance must be >= 0, got 50 and -0.5"),
        ({"tolerance": float("nan")}, ValueError, "max_iterations and tolerance must be >= 0, got 50 and nan"),
    ],
)
def test_wrong_options(option, error, message):
    """Of the points, weights and matrices see test_contract.py."""
    with pytest.raises(error, match=message):
        refine_fundamental(uniform(1, 10, 2), uniform(1, 10, 2), uniform(1, 3, 3), **option)
