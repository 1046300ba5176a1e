"""Reweighted least squares on the singularity constraint against null spaces in numpy and Levenberg-Marquardt."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import epipolar_distances, scenes, uniform, up_to_sign

from kornia_learnnorm import find_fundamental
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import Cauchy, Truncated, squared_loss
from kornia_learnnorm.geometry.constrained_fit import constrained_fit
from kornia_learnnorm.geometry.distances import sampson_scale, symmetric_scale
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.scoring import PairScorer


@pytest.fixture(params=["driving", "handheld", "orbit"])
def scene(request):
    return scenes(request.param, 1, 200, noise=0.5, outliers=0.2)


NAMES = {sampson_scale: "sampson", symmetric_scale: "symmetric"}


def begin(scene, number: int = 3):
    """A scorer, and matrices of samples of twelve inliers in its coordinates."""
    points = scene.points1[0], scene.points2[0]
    inliers = torch.nonzero(scene.inliers[0])[:, 0]
    rows = inliers[uniform(number, len(inliers)).topk(12).indices]
    scorer = PairScorer(*points, 1.0, Fundamental())
    return scorer, scorer.from_pixels(find_fundamental(*(p[rows] for p in points)))


def reference(x1, x2, F_mat, losses, factor) -> np.ndarray:
    """The same steps one correspondence at a time, the constraints solved by their null space."""
    x1, x2, fitted, flat = x1.numpy().T, x2.numpy().T, [], np.diag([1.0, 1, 0])
    xi = np.stack([np.kron(b, a) for a, b in zip(x1, x2, strict=True)])
    covariances1 = np.stack([np.kron(np.outer(b, b), flat) for b in x2])
    covariances2 = np.stack([np.kron(flat, np.outer(a, a)) for a in x1])
    for F in F_mat.numpy():
        u = F.ravel() / np.linalg.norm(F)
        for step, loss in enumerate(losses):
            F = u.reshape(3, 3)
            normals = [torch.from_numpy(np.einsum("j,njk,k->n", u, V, u)) for V in (covariances1, covariances2)]
            g, slope1, slope2 = (values.numpy() for values in factor(*normals))
            weights = loss(torch.from_numpy((xi @ u * g) ** 2))[1].numpy()
            X = np.einsum("n,nj,nk->jk", weights * g**2, xi, xi)
            if step:
                for slope, V in ((slope1, covariances1), (slope2, covariances2)):
                    X += np.einsum("n,njk->jk", 2 * weights * (xi @ u) ** 2 * g * slope, V)
            U, s, Vh = np.linalg.svd(F)
            minors = np.diag([s[1] * s[2], s[2] * s[0], s[0] * s[1]])
            cofactors = np.linalg.det(U) * np.linalg.det(Vh) * (U @ minors @ Vh).ravel()
            C = np.stack([u, cofactors])
            length = 1.3 if step else 1
            particular = np.linalg.pinv(C) @ [1, cofactors @ u - np.linalg.det(F) / length]
            null = np.linalg.svd(C)[2][2:].T
            v = particular - null @ np.linalg.solve(null.T @ X @ null, null.T @ X @ particular)
            u = u + length * (v - u)
            u /= np.linalg.norm(u)
        fitted.append(u.reshape(3, 3))
    return np.stack(fitted)


@pytest.mark.parametrize("factor", [sampson_scale, symmetric_scale])
class TestSteps:
    @pytest.mark.parametrize("losses", [[squared_loss], [Truncated(3.0), Truncated(1.0)], 3 * [Cauchy(0.5)]])
    def test_against_null_spaces_in_numpy(self, scene, factor, losses):
        scorer, F0 = begin(scene)
        found = constrained_fit(scorer.x1, scorer.x2, F0, losses, factor).F_mat
        expected = reference(scorer.x1, scorer.x2, F0, losses, factor)
        for f, e in zip(found, expected, strict=True):
            assert up_to_sign(f[None], e[None]) < 1e-6

    def test_ends_at_the_optimum(self, scene, factor):
        """From there Levenberg-Marquardt does not lower the cost."""
        scorer, F0 = begin(scene, 8)
        loss = Truncated(2.0)
        fit = constrained_fit(scorer.x1, scorer.x2, F0, 40 * [loss], factor)
        start = scorer.to_pixels(fit.F_mat)
        refined = refine_fundamental(*scene[:2], start, None, NAMES[factor], loss, tolerance=1e-5)
        np.testing.assert_allclose(refined.cost_before, refined.cost, rtol=1e-6)
        np.testing.assert_allclose(fit.cost, refined.cost, rtol=1e-6)
        values = torch.linalg.svdvals(fit.F_mat)
        assert torch.allclose(values.norm(dim=-1), torch.ones(8, dtype=values.dtype))
        assert (values[:, 2] < 1e-5 * values[:, 1]).all()
        assert fit.gain.max() < 1e-10

    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
    def test_gain(self, name, factor):
        """Close to the optimum of least squares a step is to take away what is there above it."""
        scorer, F0 = begin(scenes(name, 1, 200, noise=0.5), 8)
        near, optimum = (constrained_fit(scorer.x1, scorer.x2, F0, n * [squared_loss], factor) for n in (4, 30))
        assert (near.gain / (near.cost / optimum.cost - 1)).median() == pytest.approx(1, rel=0.15)

    @settings(max_examples=5)
    @given(order=st.permutations(range(200)))
    def test_neither_the_order_of_the_points_nor_of_the_views_counts(self, factor, order):
        scorer, F0 = begin(scenes("handheld", 1, 200, noise=0.5))
        x1, x2, losses = scorer.x1, scorer.x2, 3 * [Cauchy(1.0)]
        forth = constrained_fit(x1, x2, F0, losses, factor).F_mat
        shuffled = constrained_fit(x1[:, order], x2[:, order], F0, losses, factor).F_mat
        back = constrained_fit(x2, x1, F0.mT, losses, factor).F_mat
        torch.testing.assert_close((shuffled, back.mT), (forth, forth), rtol=1e-6, atol=1e-8)


class TestResults:
    @pytest.mark.parametrize("factor", [sampson_scale, symmetric_scale])
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
            assert epipolar_distances(points1[None, 1:], points2[None, 1:], F[None]).max() < 1e-6

    def test_truncated_points_are_as_if_absent(self, scene):
        scorer, F0 = begin(scene, 1)
        near = scorer.inliers(F0)[0]
        fitted = constrained_fit(scorer.x1, scorer.x2, F0, [Truncated(1.0)])
        alone = constrained_fit(scorer.x1[:, near], scorer.x2[:, near], F0, [squared_loss])
        assert torch.allclose(fitted.F_mat, alone.F_mat)
        assert torch.allclose(fitted.cost, alone.cost + (~near).sum())

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
        with pytest.raises(ValueError, match="needs a loss for each step, got none"):
            constrained_fit(scorer.x1, scorer.x2, F0, [])
