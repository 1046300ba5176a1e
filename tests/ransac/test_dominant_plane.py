"""RANSAC where most matches lie on one plane: the plane, its matrix with parallax, and when neither is tried."""

import math

import numpy as np
import pytest
import torch
from plane_scene import H, make_scene
from references import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac import dominant_plane as module
from kornia_learnnorm.ransac import ransac
from kornia_learnnorm.ransac.scoring import PairScorer


def scorer_and_plane(points: tuple[torch.Tensor, torch.Tensor]) -> tuple[PairScorer, torch.Tensor]:
    scorer = PairScorer(*points, 1.0, Fundamental("optimal"))
    return scorer, scorer.T2 @ H @ torch.linalg.inv(scorer.T1)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


class TestParallax:
    @pytest.mark.parametrize(("off", "outliers", "noise", "most"), [(5, 0, 0.0, 1e-5), (15, 60, 0.3, 1.0)])
    def test_the_matches_off_the_plane_are_on_their_lines(self, off, outliers, noise, most):
        points = make_scene(300, off, outliers, noise)
        scorer, plane = scorer_and_plane(points)
        F_mat = unit_matrix(scorer.to_pixels(module.fit_parallax(scorer, plane, generator()).F_mat))[0]
        assert np.median(epipolar_distances(*(p[300 : 300 + off] for p in points), F_mat)) < most

    def test_two_matches_off_the_plane_are_too_few(self):
        assert len(module.fit_parallax(*scorer_and_plane(make_scene(50, 2, 0, 0.0)), generator()).F_mat) == 0


class TestPlane:
    def test_of_any_matrix_that_fits_it(self):
        """That of a wrong epipole has the homography, too."""
        scorer, plane = scorer_and_plane(make_scene(300, 0, 30, 0.2))
        e2 = torch.tensor([0.3, 0.5, 0.8]).double()
        F = unit_matrix((torch.linalg.cross(e2.expand(3, 3), plane.mT).mT)[None])
        found = unit_matrix(module.find_dominant_plane(scorer, F, generator())[None])[0]
        assert module.offsets(found, scorer.x1, scorer.x2)[:300].median() < 0.5

    def test_of_a_scene_with_relief_there_is_none(self):
        """Where half of the matches are on a plane, and where the rest is too many to agree by chance."""
        for plane, off in ((100, 100), (300, 100)):
            points = make_scene(plane, off, 50, 0.2)
            scorer, _ = scorer_and_plane(points)
            F = scorer.from_pixels(kln.RANSAC(seed=0)(*points)[0][None])
            assert module.find_dominant_plane(scorer, F, generator()) is None

    def test_chance_by_hand(self):
        """Six of ten matches at ten thresholds from the plane agree."""
        distance, inliers = torch.full((10,), 10.0), torch.arange(10) < 6
        expected = 10 * 2 / math.pi * math.asin(0.1)
        found = module.log_chance(distance, inliers)
        assert found == pytest.approx(math.log(100) - (6 * math.log(6 / expected) - 6 + expected))
        assert module.log_chance(distance, inliers & False) == pytest.approx(math.log(100))
        assert module.log_chance(torch.zeros(10), inliers) == 0  # nothing is off the plane
        assert math.isfinite(module.log_chance(torch.full((10,), math.inf), inliers))


def errors(number: int = 12) -> list[float]:
    """Median distances, over scenes, of the few matches off a plane from the lines of RANSAC's matrix."""
    found = []
    for seed in range(number):
        points = make_scene(300, 30, 200, 0.5, seed)
        F_mat = kln.RANSAC(seed=seed)(*points)[0]
        found.append(float(np.median(epipolar_distances(*(p[300:330] for p in points), F_mat))))
    return found


def test_few_matches_off_the_plane_decide(monkeypatch):
    with_plane = errors()
    monkeypatch.setattr(ransac, "try_dominant_plane", lambda scorer, pool, generator: pool)
    without = errors()
    print(np.round(with_plane, 2), np.round(without, 2))
    assert sum(error < 1.5 for error in with_plane) > sum(error < 1.5 for error in without)
    assert sum(error < 1.5 for error in with_plane) >= 11
