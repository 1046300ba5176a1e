"""Corrections to rank 2 and reweighted fits of that rank: against NumPy and Levenberg-Marquardt."""

import numpy as np
import pytest
import references as ref
import torch
from pairwise import pairwise
from scenes import correspondences, raises, scenes, uniform

from kornia_learnnorm import Hartley, Whitening, find_fundamental
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import Truncated, squared_loss
from kornia_learnnorm.geometry.constrained_fit import constrained_fit
from kornia_learnnorm.geometry.distances import DISTANCE_SCALES
from kornia_learnnorm.geometry.matrices import nearest_rank2
from kornia_learnnorm.geometry.rank2_correction import optimal_rank2
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.scoring import PairScorer


def reference(F, points1, points2, iterations: int = 3) -> np.ndarray:
    """Kanatani and Sugaya's correction set by set: pseudo-inverses, and covariances from the Jacobian of xi."""
    T1, T2 = ref.numpy_hartley(points1), ref.numpy_hartley(points2)
    start = ref.unit(np.linalg.inv(T2).swapaxes(-1, -2) @ np.asarray(F) @ np.linalg.inv(T1)).reshape(-1, 9)
    x1, x2 = (ref.homogeneous(p.numpy()) @ T.swapaxes(-1, -2) for p, T in ((points1, T1), (points2, T2)))
    corrected = []
    for k, u in enumerate(start):
        P, M = np.eye(9) - np.outer(u, u), np.zeros((9, 9))
        for a, b in zip(x1[k], x2[k], strict=True):
            pixels = [np.kron(b, T1[k][:, c]) for c in (0, 1)] + [np.kron(T2[k][:, c], a) for c in (0, 1)]
            xi = P @ np.kron(b, a)
            M += np.outer(xi, xi) / sum((u @ derivative) ** 2 for derivative in pixels)
        values, vectors = np.linalg.eigh(M)
        V = (vectors[:, 1:] / values[1:]) @ vectors[:, 1:].T
        for _ in range(iterations):
            G = u.reshape(3, 3)
            cofactors = np.cross(G[[1, 2, 0]], G[[2, 0, 1]]).reshape(9)  # an inverse does not exist in the last round
            u = u - (u @ cofactors) / 3 / (cofactors @ V @ cofactors) * V @ cofactors
            u = u / np.linalg.norm(u)
            P = np.eye(9) - np.outer(u, u)
            V = P @ V @ P
        U, s, Vh = np.linalg.svd(u.reshape(3, 3))
        corrected.append(T2[k].T @ U @ np.diag([s[0], s[1], 0]) @ Vh @ T1[k])
    return ref.unit(np.stack(corrected))


class TestOptimalRank2:
    @pairwise(name=["driving", "handheld", "orbit"], num_points=[8, 12, 50])
    def test_agrees_with_numpy(self, name, num_points):
        points = correspondences(name, 10, num_points, noise=0.2)
        F0 = ref.rank_three(*points)
        F_mat, expected = optimal_rank2(F0, *points), reference(F0, *points)
        assert ref.hartley_difference(F_mat, expected, *points) < 1e-5
        assert ref.hartley_difference(find_fundamental(*points, rank2="optimal"), F_mat, *points) < 1e-6

    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
    def test_fits_eight_points_far_better_than_hartley(self, name):
        points = correspondences(name, 200, 8, noise=0.5)
        F_mats = find_fundamental(*points), optimal_rank2(ref.rank_three(*points), *points)
        plain, corrected = (ref.epipolar_distances(*points, F_mat).mean(-1) for F_mat in F_mats)
        assert (corrected < plain).mean() > 0.97
        assert np.median(corrected) < 0.3 * np.median(plain)

    @pytest.mark.parametrize("num_points", [8, 11])
    def test_gradients(self, num_points):
        points = [uniform(2, num_points, 2, low=-1, seed=seed) for seed in (1, 2)]
        weights = uniform(2, num_points, low=0.5, seed=3)
        ref.check_gradients(lambda *v: ref.signless(optimal_rank2(*v)), ref.rank_three(*points), *points, weights)

    def test_in_the_solver_the_normalisation_of_eight_points_does_not_matter(self):
        points = correspondences("driving", 20, 8, noise=0.5)
        results = [find_fundamental(*points, normalizer=n, rank2="optimal") for n in (Hartley(), Whitening())]
        assert ref.hartley_difference(*results, *points) < 1e-6


class TestRank2Projection:
    @pytest.mark.parametrize("shape", [(), (0,), (50,), (2, 4)])
    def test_is_the_truncated_decomposition(self, shape, dtype, device):
        F_mat = uniform(*shape, 3, 3, low=-1).to(device, dtype)
        U, s, Vh = np.linalg.svd(F_mat.cpu().double().numpy())
        expected = U[..., :2] * s[..., None, :2] @ Vh[..., :2, :]
        found = nearest_rank2(F_mat)
        assert (found.shape, found.dtype) == ((*shape, 3, 3), dtype)
        np.testing.assert_allclose(found.cpu().numpy(), expected, atol=20 * torch.finfo(dtype).eps)


def begin(scene, number: int = 3):
    """A scorer, and matrices of samples of twelve inliers in its coordinates."""
    points = scene.points1[0], scene.points2[0]
    inliers = torch.nonzero(scene.inliers[0])[:, 0]
    rows = inliers[uniform(number, len(inliers)).topk(12).indices]
    scorer = PairScorer(*points, 1.0, Fundamental())
    return scorer, scorer.from_pixels(find_fundamental(*(p[rows] for p in points)))


@pytest.mark.parametrize(("kind", "factor"), DISTANCE_SCALES.items())
@pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
class TestSteps:
    def test_ends_at_the_optimum(self, name, kind, factor):
        """From there Levenberg-Marquardt does not lower the cost."""
        scene = scenes(name, 1, 200, noise=0.5, outliers=0.2)
        scorer, F0 = begin(scene, 8)
        loss = Truncated(2.0)
        fit = constrained_fit(scorer.x1, scorer.x2, F0, 40 * [loss], factor)
        start = scorer.to_pixels(fit.F_mat)
        refined = refine_fundamental(*scene[:2], start, None, kind, loss, tolerance=1e-5)
        np.testing.assert_allclose(refined.cost_before, refined.cost, rtol=1e-6)
        np.testing.assert_allclose(fit.cost, refined.cost, rtol=1e-6)
        values = torch.linalg.svdvals(fit.F_mat)
        assert torch.allclose(values.norm(dim=-1), torch.ones(8, dtype=values.dtype))
        assert (values[:, 2] < 1e-5 * values[:, 1]).all()
        assert fit.gain.max() < 1e-10

    def test_gain(self, name, kind, factor):
        """Close to the optimum of least squares a step is to take away what is there above it."""
        scorer, F0 = begin(scenes(name, 1, 200, noise=0.5), 8)
        near, optimum = (constrained_fit(scorer.x1, scorer.x2, F0, n * [squared_loss], factor) for n in (4, 30))
        assert (near.gain / (near.cost / optimum.cost - 1)).median() == pytest.approx(1, rel=0.15)


class TestResults:
    @pytest.mark.parametrize("factor", DISTANCE_SCALES.values())
    def test_a_point_on_the_epipole_does_not_outweigh_the_others(self, factor):
        epipole = torch.full((2,), 300.0, dtype=torch.float64)
        points1 = uniform(200, 2, high=600)
        points2 = epipole + (points1 - epipole) * uniform(200, 1, low=1.1, high=1.4, seed=1)
        points1[0] = points2[0] = epipole
        F_true = torch.tensor([[[0.0, -1, 300], [1, 0, -300], [-300, 300, 0]]], dtype=torch.float64)
        scorer = PairScorer(points1, points2, 1.0, Fundamental())
        F0 = scorer.from_pixels(torch.cat([F_true, F_true + 1e-4 * uniform(3, 3, 3, seed=3)]))
        fitted = constrained_fit(scorer.x1, scorer.x2, F0, 8 * [Truncated(3.0)], factor).F_mat
        for F in scorer.to_pixels(fitted):
            assert ref.epipolar_distances(points1[None, 1:], points2[None, 1:], F[None]).max() < 1e-6

    def test_what_cannot_be_fitted_stays(self):
        """Without inliers a step has no equations, and another matrix in the batch must not notice."""
        scorer, F0 = begin(scenes("handheld", 1, 200, noise=0.5))
        hopeless = torch.tensor([[[0.0, 0, 0], [0, 0, -1], [0, 1, 1e4]]], dtype=F0.dtype)
        fit = constrained_fit(scorer.x1, scorer.x2, torch.cat([F0, hopeless]), 2 * [Truncated(1.0)])
        others = constrained_fit(scorer.x1, scorer.x2, F0, 2 * [Truncated(1.0)])
        assert torch.allclose(fit.F_mat[3], hopeless[0] / hopeless.norm())
        assert torch.allclose(fit.F_mat[:3], others.F_mat)
        assert torch.allclose(fit.cost[:3], others.cost)
        assert fit.cost[3] == torch.inf
        zero = constrained_fit(scorer.x1, scorer.x2, torch.zeros_like(F0), [squared_loss])
        assert not bool(zero.F_mat.isfinite().any())
        raises(ValueError, "needs a loss for each step, got none", constrained_fit, scorer.x1, scorer.x2, F0, [])
