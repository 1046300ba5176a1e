"""RANSAC where most matches lie on one plane: the plane, its matrix with parallax, and when neither is tried."""

import math

import numpy as np
import pytest
import torch
from plane_scene import fit_parallax, in_scorer, make_scene
from references import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.ransac import dominant_plane as module
from kornia_learnnorm.ransac import ransac


def find_plane(scorer, F):
    return module.find_dominant_plane(scorer, unit_matrix(F[None]), torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("off", "outliers", "noise", "most"), [(5, 0, 0.0, 1e-5), (15, 60, 0.3, 1.0)])
def test_matches_off_the_plane_determine_the_matrix(off, outliers, noise, most):
    points = make_scene(300, off, outliers, noise)
    assert np.median(epipolar_distances(*(p[300 : 300 + off] for p in points), fit_parallax(points)[0])) < most
    assert len(fit_parallax(make_scene(50, 2, 0, 0.0))) == 0  # too few


def test_the_plane_of_a_matrix_with_any_epipole():
    scorer, plane = in_scorer(make_scene(300, 0, 30, 0.2))
    found = find_plane(scorer, torch.linalg.cross(plane.new_tensor([0.3, 0.5, 0.8]).expand(3, 3), plane.mT).mT)
    assert module.offsets(found, scorer.x1, scorer.x2)[:300].median() < 0.5


@pytest.mark.parametrize(("plane", "off", "outliers"), [(10, 14, 40), (20, 10, 5), (300, 60, 200)])
def test_relief_is_no_plane(plane, off, outliers):
    """Half of the matches are off the plane, or most of those off it agree, or more than would by chance."""
    scorer, _ = in_scorer(points := make_scene(plane, off, outliers, 0.2))
    assert find_plane(scorer, scorer.from_pixels(kln.RANSAC(seed=0)(*points)[0])) is None


def test_chance_by_hand():
    """Six of ten matches at ten thresholds from the plane agree."""
    distance, inliers, expected = torch.full((10,), 10.0), torch.arange(10) < 6, 20 / math.pi * math.asin(0.1)
    found = module.log_chance(distance, inliers)
    assert found == pytest.approx(math.log(100) - (6 * math.log(6 / expected) - 6 + expected))
    assert module.log_chance(distance, inliers & False) == pytest.approx(math.log(100))
    assert module.log_chance(torch.zeros(10), inliers) == 0  # nothing is off the plane
    assert math.isfinite(module.log_chance(torch.full((10,), math.inf), inliers))


def test_ransac_finds_the_parallax_of_few_matches(monkeypatch):
    def successes():
        scenes = [make_scene(300, 30, 200, 0.5, seed) for seed in range(12)]
        found = [kln.RANSAC(seed=0)(*points)[0] for points in scenes]
        errors = [epipolar_distances(*(p[300:330] for p in points), F) for points, F in zip(scenes, found, strict=True)]
        return sum(np.median(error) < 1.5 for error in errors)

    assert successes() >= 11
    monkeypatch.setattr(ransac, "try_dominant_plane", lambda scorer, pool, generator: pool)
    assert successes() < 8
