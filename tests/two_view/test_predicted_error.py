"""The predicted error of a matrix against the true one, and reasons to doubt it."""

import math

import numpy as np
import pytest
import torch
from references import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.data.synthetic.random_matches import random_planes
from kornia_learnnorm.two_view.pair_warnings import find_warnings, log_false_alarms, log_false_samples
from kornia_learnnorm.two_view.predicted_error import (
    drop_failed_parts,
    predict_error,
    predict_transfer_error,
    random_parts,
)


def test_failed_searches_do_not_count():
    """Of 100 inliers, a matrix of a part must have 75; with fewer than four such matrices all count."""
    F_parts = torch.eye(3).double() * torch.arange(1.0, 7.0)[:, None, None]
    support = torch.tensor([110, 75, 74, 20, 90, 80])
    assert drop_failed_parts(F_parts, support, 100)[:, 0, 0].tolist() == [1, 2, 5, 6]
    assert len(drop_failed_parts(F_parts, support, 101)) == 6
    assert torch.equal(drop_failed_parts(F_parts, support, 10), F_parts)


@pytest.mark.parametrize("number", [40, 200])
def test_predicted_error_is_near_the_true_one(number):
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


def test_predicted_error_is_infinite_where_parts_have_no_matrix():
    scene = handheld(1, 50, torch.Generator().manual_seed(0), noise=0.0)
    x1, x2, F_mat, K1, K2 = (value[0] for value in (scene.points1, scene.points2, scene.F_mat, scene.K1, scene.K2))
    found = predict_error(torch.zeros(12, 3, 3).double(), 40, x1, x2, F_mat, torch.ones(50, dtype=torch.bool), K1, K2)
    assert found.distance == math.inf
    assert found.angle > 100


SIZE = (640, 480)
ALL = torch.ones(100, dtype=torch.bool)
MOST = torch.arange(100) < 80


def codes(points1, points2, inliers, angle=0.1) -> list[str]:
    found = find_warnings(points1, points2, inliers, 1.0, SIZE, angle)
    assert all(warning.text and "\n" not in warning.text for warning in found)
    return [warning.code for warning in found]


def test_warnings():
    rng = np.random.default_rng(0)
    points1, points2 = (torch.from_numpy(rng.uniform([0, 0], SIZE, (100, 2))) for _ in range(2))
    assert codes(points1, points2, MOST) == []
    assert codes(points1, points2, torch.arange(100) < 12) == ["few_inliers", "chance"]
    assert codes(points1, points2, MOST, angle=20.0) == ["unstable"]
    assert codes(points1 * torch.tensor([1.0, 0.01]), points2, ALL) == ["clustered"]


def test_support_that_chance_would_give():
    """By hand for 12 of 100 in 1226 x 370: 10^(15.0 + 2.9 + 2.0 - 5 * 2.25) models expected, far more than one.

    For 9 of 100 in 640 x 480, 10^(12.3 + 2.1 + 2.0 - 5 * 4.99) homographies from four matches are expected.
    """
    found = [log_false_alarms(100, inliers, 1.0, (1226, 370)) for inliers in (12, 16, 29, 60)]
    assert [value > -2 for value in found] == [True, True, False, False]
    assert found[0] == pytest.approx(15.02 + 2.90 + 1.97 - 5 * 2.248, abs=0.02)
    found = log_false_alarms(100, 9, 1.0, SIZE, "homography")
    assert found == pytest.approx(12.28 + 2.10 + 1.98 - 5 * 4.990, abs=0.02)


def test_false_samples():
    """No less than the binomial tail, summed term by term, and small where the tail is."""
    strip, others = 2 * 800 / (640 * 480), 300 - 8
    for inliers in (12, 18, 24):
        terms = [math.comb(others, k) * strip**k * (1 - strip) ** (others - k) for k in range(inliers - 8, others)]
        value, exact = log_false_samples(300, inliers, 1.0, (640, 480)), math.log10(50_000 * sum(terms))
        assert exact < value < exact + 1
    assert log_false_samples(5, 0, 1.0, (640, 480)) > 0


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


def test_angles_of_homographies():
    """Half of the matches have as large an error as what they differ by from all."""
    points, inliers = torch.rand(100, 2).double(), torch.ones(100, dtype=torch.bool)
    about = torch.eye(3).double().repeat(3, 1, 1), 50, points, torch.eye(3).double(), inliers
    assert predict_transfer_error(*about, torch.tensor([1.0, 2.0, 180.0])) == (0.0, 2.0)
