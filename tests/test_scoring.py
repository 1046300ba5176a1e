"""Scores in float32 by matrix products against distances one by one, and samples that determine nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from two_view import correspondences, epipolar_distances, scenes, uniform

from kornia_learnnorm import find_fundamental, sampson_distance
from kornia_learnnorm.objectives import sampson_factor, symmetric_factor
from kornia_learnnorm.scoring import PairScorer, epipolar_distance


@pytest.fixture
def pair():
    scene = scenes("handheld", 1, 500, noise=0.5, outliers=0.3)
    return scene.points1[0], scene.points2[0]


@pytest.fixture
def matrices(pair):
    rows = torch.rand(200, 500, generator=torch.Generator().manual_seed(1)).topk(8).indices
    return find_fundamental(pair[0][rows], pair[1][rows])


def distances(points1, points2, F, factor) -> np.ndarray:
    if factor is symmetric_factor:
        return epipolar_distances(points1, points2, F)
    return sampson_distance(points1.expand(len(F), -1, -1), points2.expand(len(F), -1, -1), F).numpy()


@pytest.mark.parametrize("factor", [sampson_factor, symmetric_factor])
class TestBest:
    def test_scores_of_distances(self, pair, matrices, factor):
        best = PairScorer(*pair, 1.5, factor).best(matrices, 200)
        reference = distances(*pair, matrices, factor)
        scores = np.maximum(0, 1 - (reference / 1.5) ** 2).sum(-1)
        counts = (reference <= 1.5).sum(-1)
        supported = np.sort(scores[counts > 8])[::-1]
        assert np.allclose(best.score, supported, atol=0.02)
        own = distances(*pair, best.F_mat, factor)
        assert np.abs(best.support.numpy() - (own <= 1.5).sum(-1)).max() <= 1  # a distance next to the threshold

    def test_fewer_than_asked_for(self, pair, matrices, factor):
        scorer = PairScorer(*pair, 1.5, factor)
        assert len(scorer.best(matrices[:3], 8).F_mat) <= 3
        best, joined = scorer.best(matrices, 8), scorer.best(matrices[100:], 8).join(scorer.best(matrices[:100], 8), 8)
        assert torch.equal(best.score, joined.score)

    @given(scale=st.sampled_from([-1e6, -1.0, 1e-6, 3.0]))
    def test_scale_and_sign_do_not_count(self, factor, scale):
        points = correspondences("driving", 1, 60)
        scorer = PairScorer(points[0][0], points[1][0], 1.0, factor)
        F = find_fundamental(points[0][:, :20], points[1][:, :20])
        assert torch.allclose(scorer.best(F, 1).score, scorer.best(scale * F, 1).score, rtol=1e-3)

    def test_nothing_speaks_for_zero_or_nan(self, pair, factor):
        F = torch.stack([torch.zeros(3, 3), torch.full((3, 3), torch.nan), torch.full((3, 3), torch.inf)]).double()
        assert len(PairScorer(*pair, 1.0, factor).best(F, 3).F_mat) == 0

    def test_distance(self, pair, matrices, factor):
        got = epipolar_distance(pair[0][None], pair[1][None], matrices, factor)
        assert np.allclose(got, distances(*pair, matrices, factor), rtol=1e-6)


class TestDetermined:
    @pytest.fixture
    def scorer(self, pair):
        return PairScorer(*pair, 1.0)

    def test_samples_in_space(self, scorer):
        points1, points2 = correspondences("random", 200, 8)
        assert scorer.determined(points1, points2).float().mean() > 0.98

    def test_coincident(self, scorer):
        points1, points2 = correspondences("handheld", 20, 8)
        for points in (points1, points2):
            points[:, 5] = points[:, 2]
        assert not scorer.determined(points1, points2).any()

    def test_on_a_line(self, scorer):
        along = torch.linspace(0, 300, 8, dtype=torch.float64)
        points1 = torch.stack([along, 2 * along + 5], -1)[None]
        points2 = uniform(1, 8, 2, high=500)
        points2[..., 1] = 3 * points2[..., 0]
        assert not scorer.determined(points1, points2).any()

    def test_on_a_plane(self, scorer):
        H = torch.tensor([[1.1, 0.02, 30], [0.01, 0.95, -12], [1e-4, 2e-5, 1]], dtype=torch.float64)
        points1 = uniform(50, 8, 2, high=500)
        x2 = torch.cat([points1, torch.ones(50, 8, 1)], -1) @ H.mT
        assert not scorer.determined(points1, x2[..., :2] / x2[..., 2:]).any()

    def test_seven_on_a_plane(self, scorer):
        H = torch.tensor([[1.0, 0, 30], [0, 1, -12], [0, 0, 1]], dtype=torch.float64)
        points1 = uniform(50, 8, 2, high=500)
        points2 = (torch.cat([points1, torch.ones(50, 8, 1)], -1) @ H.mT)[..., :2]
        points2[:, 7] += 20
        assert not scorer.determined(points1, points2).any()
