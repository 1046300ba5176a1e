"""Scores in float32 by matrix products against distances one by one, and samples that determine nothing."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import correspondences, epipolar_distances, scenes, uniform

from kornia_learnnorm import find_fundamental, sampson_distance
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac.scoring import PairScorer, finite_and_bounded


@pytest.fixture
def pair():
    scene = scenes("handheld", 1, 500, noise=0.5, outliers=0.3)
    return scene.points1[0], scene.points2[0]


@pytest.fixture
def matrices(pair):
    rows = torch.rand(200, 500, generator=torch.Generator().manual_seed(1)).topk(8).indices
    return find_fundamental(pair[0][rows], pair[1][rows])


def distances(points1, points2, F, factor) -> np.ndarray:
    if factor == "symmetric":
        return epipolar_distances(points1, points2, F)
    return sampson_distance(points1.expand(len(F), -1, -1), points2.expand(len(F), -1, -1), F).numpy()


@pytest.mark.parametrize("factor", ["sampson", "symmetric"])
class TestBest:
    def test_scores_of_distances(self, pair, matrices, factor):
        scorer = PairScorer(*pair, 1.5, Fundamental(distance=factor))
        best = scorer.best(scorer.from_pixels(matrices), 200)
        reference = distances(*pair, matrices, factor)
        scores = np.maximum(0, 1 - (reference / 1.5) ** 2).sum(-1)
        assert np.allclose(best.score, np.sort(scores)[::-1][: len(best.score)], atol=0.02)
        own = distances(*pair, scorer.to_pixels(best.F_mat), factor)
        counts = scorer.inliers(best.F_mat).sum(-1).numpy()
        assert np.abs(counts - (own <= 1.5).sum(-1)).max() <= 1  # a distance next to the threshold

    def test_nothing_speaks_for_zero_or_nan(self, pair, factor):
        F = torch.tensor([0.0, torch.nan, torch.inf]).double()[:, None, None].expand(3, 3, 3)
        assert len(PairScorer(*pair, 1.0, Fundamental(distance=factor)).best(F, 3).F_mat) == 0


class TestFiniteAndBounded:
    @given(scale=st.sampled_from([1e-9, 1e-3, 1e9]), shift=st.sampled_from([0.0, -1e6, 1e12]))
    def test_similarities(self, scale, shift):
        points1, points2 = correspondences("driving", 1, 60)
        moved = scale * points1[0] + shift, scale * points2[0] + shift
        assert finite_and_bounded(*moved, scale).all()

    def test_float32_at_its_end(self):
        points = uniform(20, 2).float()
        points[0] = 3e38
        assert finite_and_bounded(points, -points, 1.0).tolist() == [False] + 19 * [True]
        assert not finite_and_bounded(*torch.full((2, 9, 2), torch.nan), 1.0).any()
