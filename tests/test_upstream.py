"""The sketch of the proposal to Kornia: its own solver with the transforms of a normaliser of this package."""

from __future__ import annotations

import pytest
import torch
from kornia.geometry.epipolar import fundamental
from kornia.geometry.linalg import transform_points
from two_view import scenes, uniform

import kornia_learnnorm as kln

NORMALIZERS = {"whitening": kln.Whitening(), "crossview": kln.LearnedNormalizer.from_pretrained("crossview").double()}


def run_8point(monkeypatch, points1, points2, weights, normalizer):
    """Kornia's solver, its two calls of ``normalize_points`` replaced as in the sketch."""
    transforms = iter(normalizer(points1, points2, weights))

    def normalize(points, weights=None):
        T = next(transforms)
        return transform_points(T, points), T

    with monkeypatch.context() as patch:
        patch.setattr(fundamental, "normalize_points", normalize)
        return fundamental.run_8point(points1, points2, weights)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("number", [8, 20])
@pytest.mark.parametrize("name", NORMALIZERS)
def test_results_are_those_of_this_package(monkeypatch, name, number, weighted):
    scene = scenes("handheld", 16, number)
    points1, points2 = scene.points1.double(), scene.points2.double()
    weights = uniform(16, number, seed=1) + 0.5 if weighted else None
    with torch.no_grad():
        F_mat = run_8point(monkeypatch, points1, points2, weights, NORMALIZERS[name])
        expected = kln.find_fundamental(points1, points2, weights, NORMALIZERS[name])
    F_mat = F_mat / torch.linalg.matrix_norm(F_mat, keepdim=True)
    error = torch.minimum((F_mat - expected).abs().amax((1, 2)), (F_mat + expected).abs().amax((1, 2)))
    assert error.max() < 1e-6


@pytest.mark.parametrize("number", [8, 20])
def test_gradcheck(monkeypatch, number):
    scene = scenes("handheld", 1, number)
    points = [points.double().requires_grad_() for points in (scene.points1, scene.points2)]
    assert torch.autograd.gradcheck(lambda *x: run_8point(monkeypatch, *x, None, NORMALIZERS["whitening"]), points)
