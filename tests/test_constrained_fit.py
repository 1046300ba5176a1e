"""Reweighted least squares on the singularity constraint against null spaces in numpy and Levenberg-Marquardt."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from two_view import epipolar_distances, scenes, uniform, up_to_sign

from kornia_learnnorm import find_fundamental
from kornia_learnnorm.constrained_fit import constrained_fit
from kornia_learnnorm.objectives import Cauchy, Truncated, sampson_factor, squared_loss, symmetric_factor
from kornia_learnnorm.refine import refine_fundamental
from kornia_learnnorm.scoring import PairScorer


@pytest.fixture(params=["driving", "handheld", "orbit"])
def scene(request):
    return scenes(request.param, 1, 200, noise=0.5, outliers=0.2)


def begin(scene, number: int = 3):
    """A scorer, and matrices of samples of twelve inliers in its coordinates."""
    points = scene.points1[0], scene.points2[0]
    inliers = torch.nonzero(scene.inliers[0])[:, 0]
    rows = inliers[uniform(number, len(inliers)).topk(12).indices]
    scorer = PairScorer(*points, 1.0)
    return scorer, scorer.from_pixels(find_fundamental(*(p[rows] for p in points)))


def factors(F, x1, x2, factor):
    lines1, lines2 = (F.T @ x2)[:2], (F @ x1)[:2]
    normals = torch.from_numpy((lines1**2).sum(0)), torch.from_numpy((lines2**2).sum(0))
    return factor(*normals)[0].numpy()


def reference(x1, x2, F_mat, losses, factor) -> np.ndarray:
    """The same steps, the constraints solved by their null space."""
    x1, x2, fitted = x1.numpy(), x2.numpy(), []
    xi = np.einsum("jn,kn->njk", x2, x1).reshape(-1, 9)
    for F in F_mat.numpy():
        u = F.ravel() / np.linalg.norm(F)
        for loss in losses:
            F = u.reshape(3, 3)
            g = factors(F, x1, x2, factor)
            w = loss(torch.from_numpy((xi @ u * g) ** 2))[1].numpy() * g**2
            gradient = np.linalg.det(F) * np.linalg.inv(F).T if np.linalg.matrix_rank(F, 1e-12) == 3 else None
            if gradient is None:
                U, s, Vh = np.linalg.svd(F)
                gradient = s[0] * s[1] * np.outer(U[:, 2], Vh[2]) * np.linalg.det(U) * np.linalg.det(Vh)
            C = np.stack([u, gradient.ravel()])
            particular = np.linalg.pinv(C) @ [1, gradient.ravel() @ u - np.linalg.det(F)]
            null = np.linalg.svd(C)[2][2:].T
            A = np.sqrt(w)[:, None] * xi
            v = particular - null @ np.linalg.lstsq(A @ null, A @ particular, rcond=None)[0]
            u = v / np.linalg.norm(v)
        fitted.append(u.reshape(3, 3))
    return np.stack(fitted)


@pytest.mark.parametrize("factor", [sampson_factor, symmetric_factor])
class TestSteps:
    @pytest.mark.parametrize("losses", [[squared_loss], [Truncated(3.0), Truncated(1.0)], 3 * [Cauchy(0.5)]])
    def test_against_null_spaces_in_numpy(self, scene, factor, losses):
        scorer, F0 = begin(scene)
        found = constrained_fit(scorer.x1, scorer.x2, F0, losses, factor)
        expected = reference(scorer.x1, scorer.x2, F0, losses, factor)
        for f, e in zip(found, expected, strict=True):
            assert up_to_sign(f[None], e[None]) < 1e-6

    def test_next_to_the_optimum(self, scene, factor):
        """From there Levenberg-Marquardt hardly lowers the cost; the derivatives of the factor are all that is left."""
        scorer, F0 = begin(scene, 8)
        loss = Truncated(2.0)
        F_mat = scorer.to_pixels(constrained_fit(scorer.x1, scorer.x2, F0, 12 * [loss], factor))
        refined = refine_fundamental(scene.points1, scene.points2, F_mat, None, factor, loss)
        assert (refined.cost_before / refined.cost).median() < 1.002

    @given(order=st.permutations(range(200)))
    def test_the_order_of_the_points_does_not_count(self, factor, order):
        scorer, F0 = begin(scenes("handheld", 1, 200, noise=0.5))
        fitted = [
            constrained_fit(x1, x2, F0, 3 * [Cauchy(1.0)], factor)
            for x1, x2 in ((scorer.x1, scorer.x2), (scorer.x1[:, order], scorer.x2[:, order]))
        ]
        assert torch.allclose(*fitted, rtol=1e-6)

    def test_swapping_the_views_transposes(self, scene, factor):
        scorer, F0 = begin(scene)
        forth = constrained_fit(scorer.x1, scorer.x2, F0, 3 * [Cauchy(1.0)], factor)
        back = constrained_fit(scorer.x2, scorer.x1, F0.mT, 3 * [Cauchy(1.0)], factor)
        assert torch.allclose(forth, back.mT, rtol=1e-6)


class TestResults:
    def test_exact_points(self):
        scene = scenes("orbit", 1, 100, noise=0.0)
        scorer, F0 = begin(scene)
        fitted = constrained_fit(
            scorer.x1, scorer.x2, F0 + 1e-3 * uniform(3, 3, 3) * F0.abs().max(), 6 * [squared_loss]
        )
        for F in scorer.to_pixels(fitted):
            assert epipolar_distances(scene.points1, scene.points2, F[None]).max() < 1e-6

    def test_singular_and_of_unit_norm(self, scene):
        scorer, F0 = begin(scene)
        F = constrained_fit(scorer.x1, scorer.x2, -3 * F0, 4 * [Truncated(1.5)])
        values = torch.linalg.svdvals(F)
        assert torch.allclose(values.norm(dim=-1), torch.ones(3, dtype=F.dtype))
        assert (values[:, 2] < 1e-5 * values[:, 1]).all()

    def test_truncated_points_are_as_if_absent(self, scene):
        scorer, F0 = begin(scene, 1)
        near = scorer.inliers(F0)[0]
        fitted = constrained_fit(scorer.x1, scorer.x2, F0, [Truncated(1.0)])
        assert torch.allclose(fitted, constrained_fit(scorer.x1[:, near], scorer.x2[:, near], F0, [squared_loss]))

    def test_what_cannot_be_fitted_stays(self):
        """Without inliers a step has no equations, and another matrix in the batch must not notice."""
        scorer, F0 = begin(scenes("handheld", 1, 200, noise=0.5))
        hopeless = torch.tensor([[[0.0, 0, 0], [0, 0, -1], [0, 1, 1e4]]], dtype=F0.dtype)
        fitted = constrained_fit(scorer.x1, scorer.x2, torch.cat([F0, hopeless]), 2 * [Truncated(1.0)])
        assert torch.allclose(fitted[3], hopeless[0] / hopeless.norm())
        assert torch.allclose(fitted[:3], constrained_fit(scorer.x1, scorer.x2, F0, 2 * [Truncated(1.0)]))
        zero = constrained_fit(scorer.x1, scorer.x2, torch.zeros_like(F0), [squared_loss])
        assert not bool(zero.isfinite().any())
