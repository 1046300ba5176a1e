"""Reasons to doubt a matrix, and how stable it is."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from two_view import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.two_view.parallax import parallax
from kornia_learnnorm.two_view.reliability import (
    Stability,
    assess,
    choose_found,
    find_homography,
    log_false_alarms,
    log_false_samples,
    measure_stability,
    nominal_camera,
    random_parts,
)

pytest.importorskip("cv2", reason="OpenCV is not installed")

SIZE = (640, 480)
STABLE = Stability(0.1, 0.1)


def codes(points1, points2, inliers, H=None, stability=STABLE) -> list[str]:
    distance = torch.where(inliers, 0.3, 5.0).double()
    off_plane = None if H is None else parallax(points1, points2, H)
    found = assess(points1, points2, distance, off_plane, 1.0, SIZE, stability)
    assert all(warning.text and "\n" not in warning.text for warning in found)
    return [warning.code for warning in found]


@pytest.fixture
def points() -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(0)
    return tuple(torch.from_numpy(rng.uniform([0, 0], SIZE, (100, 2))) for _ in range(2))


class TestAssess:
    def test_all_is_well(self, points):
        assert codes(*points, torch.arange(100) < 80) == []

    def test_few_inliers_and_chance(self, points):
        assert codes(*points, torch.arange(100) < 12) == ["few_inliers", "chance"]

    def test_clustered(self, points):
        line = points[0] * torch.tensor([1.0, 0.01])
        assert codes(line, points[1], torch.ones(100, dtype=torch.bool)) == ["clustered"]

    def test_planar(self, points):
        H = torch.eye(3, dtype=torch.float64)
        points1, points2 = points[0], points[0].clone()
        inliers = torch.ones(100, dtype=torch.bool)
        assert codes(points1, points2, inliers, H) == ["planar"]
        points2[:40, 0] += torch.linspace(10, 60, 40)  # forty matches with parallax along one direction
        assert codes(points1, points2, inliers, H) == []

    @pytest.mark.parametrize(
        ("relief", "distance", "found"),
        [(1.5, 0.3, []), (1.5, 0.7, ["planar"]), (0.4, 0.1, []), (0.4, 0.3, ["planar"])],
    )
    def test_little_relief(self, points, relief, distance, found):
        """Parallax in one direction is evidence where the matches fit within less than half of it."""
        points2 = points[0].clone()
        points2[:60, 0] += relief
        distances = torch.full((100,), distance, dtype=torch.float64)
        warnings = assess(points[0], points2, distances, (points2 - points[0]).norm(dim=-1), 1.0, SIZE, STABLE)
        assert [warning.code for warning in warnings] == found

    def test_unstable(self, points):
        assert codes(*points, torch.arange(100) < 80, stability=Stability(0.1, 20.0)) == ["unstable"]


class TestStability:
    def test_failed_searches_do_not_count(self):
        """Of 100 inliers, a matrix of a part must have 75; with fewer than four such matrices all count."""
        F_parts = torch.eye(3).double() * torch.arange(1.0, 7.0)[:, None, None]
        support = torch.tensor([110, 75, 74, 20, 90, 80])
        assert choose_found(F_parts, support, 100)[:, 0, 0].tolist() == [1, 2, 5, 6]
        assert len(choose_found(F_parts, support, 101)) == 6
        assert torch.equal(choose_found(F_parts, support, 10), F_parts)

    @pytest.mark.parametrize("number", [40, 200])
    def test_predicts_the_error_of_noisy_matches(self, number):
        """Against the true error on exact correspondences, over scenes: their medians agree within a factor of two."""
        generator = torch.Generator().manual_seed(number)
        exact = handheld(24, number + 200, generator, noise=0.0)
        noise = 0.5 * torch.randn(24, number, 4, generator=generator, dtype=torch.float64)
        predicted, true = [], []
        for i in range(24):
            x1 = exact.points1[i, :number] + noise[i, :, :2]
            x2 = exact.points2[i, :number] + noise[i, :, 2:]

            def solve(rows, x1=x1, x2=x2):
                F_mat = kln.find_fundamental(x1[None, rows], x2[None, rows])
                return kln.refine_fundamental(x1[None, rows], x2[None, rows], F_mat).F_mat[0]

            F_mat = solve(torch.arange(number))
            rows = random_parts(number, number, 0)
            parts = torch.stack([solve(part) for part in rows])
            inliers = torch.ones(number, dtype=torch.bool)
            K = exact.K1[i]
            predicted.append(measure_stability(parts, rows.shape[1], x1, x2, F_mat, inliers, K, K).error)
            true.append(np.median(epipolar_distances(exact.points1[i, number:], exact.points2[i, number:], F_mat)))
        assert 0.5 < np.median(predicted) / np.median(true) < 2

    def test_unstable_where_parts_have_no_matrix(self):
        generator = torch.Generator().manual_seed(0)
        scene = handheld(1, 50, generator, noise=0.0)
        found = measure_stability(
            torch.zeros(12, 3, 3, dtype=torch.float64),
            40,
            scene.points1[0],
            scene.points2[0],
            scene.F_mat[0],
            torch.ones(50, dtype=torch.bool),
            scene.K1[0],
            scene.K2[0],
        )
        assert found.error == math.inf
        assert found.angle > 100


@pytest.mark.parametrize(("inliers", "chance"), [(12, True), (16, True), (29, False), (60, False)])
def test_support_that_chance_would_give(inliers, chance):
    """By hand for 12 of 100 in 1226 x 370: 10^(15.0 + 2.9 + 2.0 - 5 * 2.25) models expected, far more than one."""
    found = log_false_alarms(100, inliers, 1.0, (1226, 370))
    assert (found > -2) == chance
    if inliers == 12:
        assert found == pytest.approx(15.02 + 2.90 + 1.97 - 5 * 2.248, abs=0.02)


def test_homography():
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform([0, 0], SIZE, (40, 2)))
    H = find_homography(points, points + 7.0, 1.0)
    assert np.allclose(H / H[2, 2], [[1, 0, 7], [0, 1, 7], [0, 0, 1]], atol=1e-6)


def test_nominal_camera():
    assert nominal_camera((640, 480)).tolist() == [[768, 0, 320], [0, 768, 240], [0, 0, 1]]


def test_false_samples():
    """No less than the binomial tail, summed term by term, and small where the tail is."""
    strip, others = 2 * 800 / (640 * 480), 300 - 8
    for inliers in (12, 18, 24):
        terms = [math.comb(others, k) * strip**k * (1 - strip) ** (others - k) for k in range(inliers - 8, others)]
        value, exact = log_false_samples(300, inliers, 1.0, (640, 480)), math.log10(50_000 * sum(terms))
        assert exact < value < exact + 1
    assert log_false_samples(5, 0, 1.0, (640, 480)) > 0
