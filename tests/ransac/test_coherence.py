"""Coherent matches, and which share of matches off a plane fits a matrix."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from two_view import WALL_SHIFT, homogeneous, repeated_wall

from kornia_learnnorm.ransac.coherence import coherent_matches, fitting_share


def wall_homography() -> torch.Tensor:
    H = torch.eye(3, dtype=torch.float64)
    H[:2, 2] = torch.from_numpy(WALL_SHIFT)
    return H


def coherent_share(points: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """The share of the 24 nearest points with a vector like a point's own."""
    apart = torch.cdist(points, points).fill_diagonal_(torch.inf).topk(24, largest=False)
    change = (vectors[apart.indices] - vectors[:, None]).norm(dim=-1)
    return (change < (0.3 * apart.values).clamp(min=3)).double().mean(-1)


class TestCoherentMatches:
    def test_true_matches_are_coherent(self):
        points1, points2, label = repeated_wall()
        coherent = coherent_matches(points1, points2, wall_homography(), 1.0)
        assert coherent[label < 2].double().mean() > 0.95
        assert not coherent[label == 2].any()

    def test_agrees_with_numpy(self):
        points1, points2, _ = (value.numpy() for value in repeated_wall(seed=1))
        vectors = points2 - points1 - WALL_SHIFT
        expected = []
        for row in range(len(points1)):
            shares = []
            for points in (points1, points2):
                apart = np.linalg.norm(points - points[row], axis=1)
                nearest = np.argsort(apart)[1:25]
                change = np.linalg.norm(vectors[nearest] - vectors[row], axis=1)
                shares.append(np.mean(change < np.maximum(0.3 * apart[nearest], 3.0)))
            expected.append(min(shares) >= 0.5)
        found = coherent_matches(torch.from_numpy(points1), torch.from_numpy(points2), wall_homography(), 1.0)
        np.testing.assert_array_equal(found.numpy(), expected)

    def test_order_and_turns_of_image_2_have_no_effect(self):
        points1, points2, _ = repeated_wall()
        expected = coherent_matches(points1, points2, wall_homography(), 1.0)
        order = torch.randperm(len(points1), generator=torch.Generator().manual_seed(0))
        turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
        turned = (points2 @ turn[:2, :2].mT)[order]
        assert (coherent_matches(points1[order], turned, turn @ wall_homography(), 1.0) == expected[order]).all()

    def test_homography_of_a_slanted_wall(self):
        """Images 1 that are warped by a homography leave the parallax as it was."""
        points1, points2, _ = repeated_wall()
        slant = torch.tensor([[1.0, 0.1, 5], [0, 1.1, 0], [8e-4, 2e-4, 1]], dtype=torch.float64)
        warped = homogeneous(points1.numpy()) @ slant.numpy().T
        warped1 = torch.from_numpy(warped[:, :2] / warped[:, 2:])
        vectors = points2 - points1
        expected = torch.minimum(coherent_share(warped1, vectors), coherent_share(points2, vectors)) >= 0.5
        H = wall_homography() @ torch.linalg.inv(slant)
        assert (coherent_matches(warped1, points2, H, 1.0) == expected).all()

    @pytest.mark.parametrize("number", [1, 2, 9])
    def test_few_matches(self, number):
        points = torch.rand(number, 2, dtype=torch.float64) * 100
        assert coherent_matches(points, points, torch.eye(3, dtype=torch.float64), 1.0).shape == (number,)


def test_fitting_share():
    """Of 40 matches off the plane of no motion, 30 move along the rows, as under a sideways motion; 10 are on it."""
    points1 = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 400
    points2 = points1.clone()
    points2[:30, 0] += 20
    points2[30:40, 1] += 20
    sideways = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    plane = torch.eye(3, dtype=torch.float64)
    assert fitting_share(points1, points2, plane, sideways, 1.0) == pytest.approx(0.75)
    assert fitting_share(points1[25:], points2[25:], plane, sideways, 1.0) == 1.0  # only 15 off the plane
