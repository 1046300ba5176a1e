"""Levenberg-Marquardt on essential matrices against Gauss-Newton in NumPy over a rotation and a direction."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import cross, homogeneous, least_squares, numpy_sampson, scenes, true_essential, uniform, up_to_sign

from kornia_learnnorm.estimators.refinement import refine_essential
from kornia_learnnorm.estimators.robust_losses import Cauchy, GemanMcClure, squared_loss
from kornia_learnnorm.geometry.minimal import solve_calibrated_samples


def disturbed(E, size: float = 0.02) -> torch.Tensor:
    return E + size * uniform(*E.shape, low=-1, seed=7)


def problem(name: str = "handheld", batch_size: int = 3, num_points: int = 40, noise: float = 0.5, **options):
    """Points, the true essential matrices and both cameras."""
    scene = scenes(name, batch_size, num_points, noise=noise, **options)
    return (scene.points1, scene.points2), true_essential(scene), (scene.K1, scene.K2)


def gauss_newton(R, t, points1, points2, K1, K2) -> float:
    """Least cost found from a pose, by a rotation vector and two angles of t."""
    t = t / np.linalg.norm(t)
    side = np.linalg.svd(t[None])[2][1:]

    def distances(q):
        angle = np.linalg.norm(q[:3]) + 1e-300
        k = cross(q[:3] / angle)
        turned = (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k) @ R
        return numpy_sampson(
            points1, points2, np.linalg.inv(K2).T @ cross(t + q[3:] @ side) @ turned @ np.linalg.inv(K1)
        )

    return least_squares(distances, np.zeros(5), 1e-7)


class TestRefineEssential:
    @pytest.mark.parametrize("batch_size", [0, 1, 5])
    def test_smoke(self, batch_size, device, dtype):
        points = [uniform(batch_size, 20, 2, high=600, seed=k).to(device, dtype) for k in (0, 1)]
        K = torch.tensor([[500.0, 0, 300], [0, 510, 200], [0, 0, 1]], device=device)
        found = refine_essential(*points, uniform(batch_size, 3, 3).to(device), K, K, max_iterations=5)
        assert [value.dtype for value in found] == [*4 * [dtype], torch.int64, torch.bool]
        assert [value.shape for value in found] == [*2 * [(batch_size, 3, 3)], *4 * [(batch_size,)]]
        assert all(value.device.type == device.type for value in found)

    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
    def test_agrees_with_numpy(self, name):
        scene = scenes(name, 3, 30, noise=0.5)
        E = true_essential(scene)
        found = refine_essential(scene.points1, scene.points2, E, scene.K1, scene.K2, max_iterations=200)
        values = (scene.R, scene.t, scene.points1, scene.points2, scene.K1, scene.K2)
        expected = [gauss_newton(*arrays) for arrays in zip(*(value.numpy() for value in values), strict=True)]
        assert found.converged.all()
        assert found.cost.numpy() == pytest.approx(expected, rel=1e-6)

    @pytest.mark.parametrize("loss", [squared_loss, Cauchy(0.5), GemanMcClure(2.0)])
    def test_costs_are_those_of_the_matrices(self, loss):
        points, E, K = problem()
        weights = uniform(3, 40)
        found = refine_essential(*points, E, *K, weights, loss)
        F0 = torch.linalg.inv(K[1]).mT @ E @ torch.linalg.inv(K[0])
        for F, cost in ((F0, found.cost_before), (found.F_mat, found.cost)):
            squares = torch.from_numpy(numpy_sampson(*points, F) ** 2)
            np.testing.assert_allclose(cost, (weights * loss(squares)[0]).sum(-1), rtol=1e-7)
        assert (found.cost <= found.cost_before).all()

    def test_what_the_matrices_are(self):
        points, E, K = problem()
        found = refine_essential(*points, disturbed(E), *K)
        values = np.linalg.svd(found.E_mat.numpy())[1]
        np.testing.assert_allclose(values, np.tile([0.5**0.5, 0.5**0.5, 0], (3, 1)), atol=1e-12)
        expected = np.linalg.inv(K[1].numpy()).swapaxes(1, 2) @ found.E_mat.numpy() @ np.linalg.inv(K[0].numpy())
        assert up_to_sign(found.F_mat, expected) < 1e-10

    @pytest.mark.parametrize("num_points", [5, 6, 20])
    def test_exact_points(self, num_points):
        points, E, K = problem(num_points=num_points, noise=0.0)
        found = refine_essential(*points, disturbed(E, 1e-3), *K)
        assert found.cost.max() < 1e-16
        if num_points > 6:
            assert up_to_sign(found.E_mat, E) < 1e-7

    def test_gradients_there_are_none(self):
        points, E, K = problem(num_points=10)
        found = refine_essential(points[0].requires_grad_(), points[1], E.requires_grad_(), *K)
        assert not any(value.requires_grad for value in found)


class TestInvariances:
    def test_neither_the_order_of_the_points_nor_of_the_views_counts(self):
        points, E, K = problem()
        order = torch.randperm(40, generator=torch.Generator().manual_seed(0))
        found, again = (refine_essential(*p, disturbed(E), *K).E_mat for p in (points, [p[:, order] for p in points]))
        assert up_to_sign(found, again) < 1e-7
        swapped = refine_essential(*points[::-1], disturbed(E).mT, *K[::-1]).E_mat
        assert up_to_sign(found, swapped.mT) < 1e-7

    @pytest.mark.parametrize("scale", [1e-3, 7.0, 1e3])
    def test_scale_of_the_pixels(self, scale):
        points, E, K = problem()
        T = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
        found = refine_essential(*points, disturbed(E), *K)
        scaled = refine_essential(*[scale * p for p in points], disturbed(E), *(T @ camera for camera in K))
        assert up_to_sign(found.E_mat, scaled.E_mat) < 1e-7
        np.testing.assert_allclose(scaled.cost, scale**2 * found.cost)

    @pytest.mark.parametrize("num_points", [20, 3000])  # as one part and as several
    def test_matrices_may_share_points(self, num_points):
        points, E, K = problem(batch_size=1, num_points=num_points)
        starts = disturbed(E.repeat(8, 1, 1))
        cameras = [camera[0] for camera in K]
        shared = refine_essential(*points, starts, *cameras, max_iterations=8)
        copied = refine_essential(*(p.repeat(8, 1, 1) for p in points), starts, *cameras, max_iterations=8)
        assert up_to_sign(shared.E_mat, copied.E_mat) < 1e-7
        assert torch.equal(shared.iterations, copied.iterations)


POINTS, EYE = uniform(2, 10, 2), torch.eye(3, dtype=torch.float64)


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"points1": POINTS[:, :4], "points2": POINTS[:, :4]}, ValueError, "at least 5 correspondences .* got 4"),
        ({"points2": POINTS[:1]}, ValueError, "must pair up"),
        ({"E_mat": EYE[None]}, ValueError, "one matrix per set of points is needed, got 1 matrices and 2 sets"),
        ({"E_mat": None}, TypeError, "E_mat must be a floating-point tensor"),
        ({"K1": None}, ValueError, "K1 and K2 must be given together, got only K2"),
        ({"K1": EYE.repeat(3, 1, 1)}, ValueError, r"K1 must have shape \[3, 3\] or \[2, 3, 3\], got \[3, 3, 3\]"),
        ({"loss": "huber"}, TypeError, "loss must be a function"),
        ({"distance": "foo"}, ValueError, "distance must be"),
        ({"max_iterations": -1}, ValueError, "must be >= 0"),
    ],
)
def test_wrong_arguments(wrong, error, message):
    arguments = {"points1": POINTS, "points2": POINTS, "E_mat": EYE.repeat(2, 1, 1), "K1": EYE, "K2": EYE}
    with pytest.raises(error, match=message):
        refine_essential(**arguments | wrong)


class TestMinimalSamples:
    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
    def test_truth_is_among_the_solutions(self, name):
        scene = scenes(name, 50, 5, noise=0.0)
        rays = [
            torch.from_numpy(homogeneous(points.numpy())) @ torch.linalg.inv(K).mT
            for points, K in ((scene.points1, scene.K1), (scene.points2, scene.K2))
        ]
        found = 0
        for k, E in enumerate(true_essential(scene)):
            solutions = solve_calibrated_samples(rays[0][k, None], 3 * rays[1][k, None])
            assert len(solutions) <= 10
            found += min(up_to_sign(solution[None], E[None]) for solution in solutions) < 1e-4
        assert found >= 48  # a few samples are nearly degenerate

    def test_repeated_correspondence_has_none(self):
        rays = uniform(2, 1, 5, 3, low=0.5)
        rays[:, :, 4] = rays[:, :, 3]
        assert solve_calibrated_samples(*rays).shape == (0, 3, 3)
        assert solve_calibrated_samples(*rays[:, :0]).shape == (0, 3, 3)
