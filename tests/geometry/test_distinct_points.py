"""Matches that share a point: the mask by hand, and what they do to RANSAC."""

import pytest
import torch
from scenes import one_scene, uniform

from kornia_learnnorm import RANSAC
from kornia_learnnorm.geometry.distinct_points import distinct_points


def test_mask_by_hand():
    """Zeros of both signs are equal; equal coordinates in another order are not."""
    points1 = torch.tensor([[0.0, 1], [-0.0, 1], [1, 0], [7, 7], [8, 8]])
    points2 = torch.tensor([[2.0, 3], [4, 5], [5, 4], [5, 4], [7, 7]])
    assert distinct_points(points1, points2).tolist() == [True, False, True, False, True]
    assert distinct_points(points1, points2, torch.arange(5)).tolist() == [False, True, False, True, True]


class TestRansac:
    @pytest.mark.parametrize("cameras", [False, True])
    def test_copies_are_absent(self, cameras):
        scene = one_scene("handheld", 200, noise=0.3, outliers=0.3)
        points, known = scene[:2], (scene.K1, scene.K2) if cameras else ()
        found = RANSAC(seed=0).estimate(*points, None, *known)
        again = RANSAC(seed=0).estimate(*(torch.cat([x, x[:50]]) for x in points), None, *known)
        assert torch.equal(found.F_mat, again.F_mat)
        assert torch.equal(torch.cat([found.inliers, torch.zeros(50, dtype=torch.bool)]), again.inliers)

    def test_the_weights_decide_which_counts(self):
        scene = one_scene("handheld", 200, noise=0.3, outliers=0.0)
        points2 = torch.cat([uniform(200, 2, high=600), scene.points2])
        weights = torch.tensor([0.1, 0.2]).repeat_interleave(200)
        _, inliers = RANSAC(seed=0)(scene.points1.repeat(2, 1), points2, weights)
        assert inliers[200:].float().mean() > 0.9
        assert not inliers[:200].any()

    def test_rows_that_are_not_finite_hide_no_match(self):
        points1, points2, *_ = one_scene("handheld", 100, noise=0.3, outliers=0.0)
        _, inliers = RANSAC(seed=0)(points1, points2)
        _, more = RANSAC(seed=0)(points1.repeat(2, 1), torch.cat([points2 * torch.nan, points2]))
        assert torch.equal(more, torch.cat([torch.zeros(100, dtype=torch.bool), inliers]))
