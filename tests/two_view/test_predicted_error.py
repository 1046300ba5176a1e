"""The predicted error of a matrix against the true one."""

import math

import numpy as np
import pytest
import torch
from scenes import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.two_view.reliability import predict_error, random_parts


@pytest.mark.parametrize("number", [40, 200])
def test_it_is_near_the_true_error(number):
    """Of exact correspondences, over scenes: the medians agree within a factor of two."""
    generator = torch.Generator().manual_seed(number)
    exact = handheld(24, number + 200, generator, noise=0.0)
    noise = 0.5 * torch.randn(24, number, 4, generator=generator, dtype=torch.float64)
    x1, x2 = exact.points1[:, :number] + noise[..., :2], exact.points2[:, :number] + noise[..., 2:]
    rows = random_parts(number, number, 0)

    def solve(points1, points2):
        return kln.refine_fundamental(points1, points2, kln.find_fundamental(points1, points2)).F_mat

    F_mat, F_parts = solve(x1, x2), solve(x1[:, rows].flatten(0, 1), x2[:, rows].flatten(0, 1)).unflatten(0, (24, -1))
    inliers = torch.ones(number, dtype=torch.bool)
    predicted = [
        predict_error(parts, rows.shape[1], *points, F, inliers, K, K).distance
        for parts, *points, F, K in zip(F_parts, x1, x2, F_mat, exact.K1, strict=True)
    ]
    true = np.median(epipolar_distances(exact.points1[:, number:], exact.points2[:, number:], F_mat), axis=-1)
    assert 0.5 < np.median(predicted) / np.median(true) < 2


def test_it_is_infinite_where_parts_have_no_matrix():
    scene = handheld(1, 50, torch.Generator().manual_seed(0), noise=0.0)
    x1, x2, F_mat, K1, K2 = (value[0] for value in (scene.points1, scene.points2, scene.F_mat, scene.K1, scene.K2))
    found = predict_error(torch.zeros(12, 3, 3).double(), 40, x1, x2, F_mat, torch.ones(50, dtype=torch.bool), K1, K2)
    assert found.distance == math.inf
    assert found.angle > 100
