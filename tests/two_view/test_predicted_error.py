"""The predicted error of a matrix against the true one."""

import math

import numpy as np
import pytest
import torch
from scenes import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.data.synthetic.random_matches import random_planes
from kornia_learnnorm.two_view.predicted_error import predict_error, predict_transfer_error, random_parts


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


@pytest.mark.parametrize("number", [40, 200])
def test_of_homographies(number):
    """The medians of exact points that are moved agree within a factor of two; no pose has a zero angle."""
    generator = torch.Generator().manual_seed(number)
    exact = random_planes(24, 1, 2 * number, generator)
    truth, H_true = exact.exact1, kln.find_homography(exact.exact1, exact.exact2)
    noise = 0.5 * torch.randn(24, number, 4, generator=generator, dtype=torch.float64)
    x1, x2 = exact.exact1[:, :number] + noise[..., :2], exact.exact2[:, :number] + noise[..., 2:]
    rows = random_parts(number, number, 0)
    H_mat = kln.find_homography(x1, x2)
    H_parts = kln.find_homography(x1[:, rows].flatten(0, 1), x2[:, rows].flatten(0, 1)).unflatten(0, (24, -1))
    inliers = torch.ones(number, dtype=torch.bool)
    found = [
        predict_transfer_error(parts, rows.shape[1], points1, H, inliers)
        for parts, points1, H in zip(H_parts, x1, H_mat, strict=True)
    ]
    moved = [np.dstack([truth, np.ones(truth.shape[:2])]) @ H.mT.numpy() for H in (H_mat, H_true)]
    error = np.linalg.norm(moved[0][..., :2] / moved[0][..., 2:] - moved[1][..., :2] / moved[1][..., 2:], axis=-1)
    assert 0.5 < np.median([one.distance for one in found]) / np.median(error[:, :number]) < 2
    assert {one.angle for one in found} == {0.0}


def test_it_is_infinite_where_parts_have_no_matrix():
    scene = handheld(1, 50, torch.Generator().manual_seed(0), noise=0.0)
    x1, x2, F_mat, K1, K2 = (value[0] for value in (scene.points1, scene.points2, scene.F_mat, scene.K1, scene.K2))
    found = predict_error(torch.zeros(12, 3, 3).double(), 40, x1, x2, F_mat, torch.ones(50, dtype=torch.bool), K1, K2)
    assert found.distance == math.inf
    assert found.angle > 100
