"""Reweighted least squares on the singularity constraint against null spaces in numpy and Levenberg-Marquardt."""

import numpy as np
import pytest
import torch
from scenes import epipolar_distances, scenes, uniform

from kornia_learnnorm import find_fundamental
from kornia_learnnorm.estimators.refinement import refine_fundamental
from kornia_learnnorm.estimators.robust_losses import Truncated, squared_loss
from kornia_learnnorm.geometry.constrained_fit import constrained_fit
from kornia_learnnorm.geometry.distances import DISTANCE_SCALES
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.scoring import PairScorer


@pytest.fixture(params=["driving", "handheld", "orbit"])
def scene(request):
    return scenes(request.param, 1, 200, noise=0.5, outliers=0.2)


def begin(scene, number: int = 3):
    """A scorer, and matrices of samples of twelve inliers in its coordinates."""
    points = scene.points1[0], scene.points2[0]
    inliers = torch.nonzero(scene.inliers[0])[:, 0]
    rows = inliers[uniform(number, len(inliers)).topk(12).indices]
    scorer = PairScorer(*points, 1.0, Fundamental())
    return scorer, scorer.from_pixels(find_fundamental(*(p[rows] for p in points)))


@pytest.mark.parametrize(("kind", "factor"), DISTANCE_SCALES.items())
class TestSteps:
    def test_ends_at_the_optimum(self, scene, kind, factor):
        """From there Levenberg-Marquardt does not lower the cost."""
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

    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
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
            assert epipolar_distances(points1[None, 1:], points2[None, 1:], F[None]).max() < 1e-6

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
